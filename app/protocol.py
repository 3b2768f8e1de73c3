"""What server and cell say to each other over the link: typed messages, strict on both ends.

The cell dials in (`WS /v1/cells/{id}/link`). Text frames carry one JSON message each; binary frames carry telemetry
rows, or poses while somebody watches. Everything the cell reports upward as an `UpEvent` bears a sequence number that
never repeats within the cell's journal, which `Hello` names; the server acknowledges the highest number that is durable
in its log, and the cell sends again what was not acknowledged.
State, beats and poses are not sequenced: only the newest matters.

Link lease: the server beats every `BEAT_MS`; a cell that has heard nothing for `LEASE_MS` holds (category 2) and
launches nothing until it has been welcomed again. Frames that come steadily may still be old, where a line is slow or
queues them: the cell beats as well, the server's beats name the newest it has heard, and a cell whose beats of the last
`AGED_MS` nobody has heard gives the link up.
"""

from __future__ import annotations

import math
import struct
from typing import Annotated, Literal, TypeAlias

import orjson
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, TypeAdapter, ValidationError

from app.governance.control import GOING_ON

LEASE_MS = 300
BEAT_MS = 75
AGED_MS = 1500  # there and back again, beats included
STATE_MS = 100
VERSION = 17
MOST_LISTED = 1000  # errors of one message: to list a quarter of a million takes seconds


Count: TypeAlias = Annotated[int, Field(strict=True, ge=0, lt=2**63)]  # as the record can write down
Name: TypeAlias = Annotated[str, Field(max_length=4096)]  # a path at most
Short: TypeAlias = Annotated[str, Field(max_length=255)]  # a thousand first words may wait for the record


def _passed_on(document: dict[str, JsonValue]) -> dict[str, JsonValue]:
    """Refuse what JSON can say and nobody can be told of: whoever is shown all cells would be shown none."""
    try:
        orjson.dumps(document)
    except TypeError as error:
        raise ValueError(f"cannot be passed on ({error}); valid are integers of 64 bits") from error
    return document


Document: TypeAlias = Annotated[dict[str, JsonValue], AfterValidator(_passed_on)]


class Message(BaseModel):
    """A message of the link: unknown fields, NaN and infinities are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


# -- down: server to cell --------------------------------------------------------------------------


class Welcome(Message):
    """First answer to `Hello`: the key authorizations are signed with, the policy in force, what the log holds."""

    type: Literal["welcome"] = "welcome"
    version: int = VERSION
    kernel_key: str  # base64 of the raw Ed25519 public key; a cell with a pinned key refuses another
    policy_digest: str
    profile: str
    acknowledged: int


class Policy(Message):
    """The bundle by digest: its files as text. The cell recomputes the digest and refuses what does not match."""

    type: Literal["policy"] = "policy"
    digest: str
    files: dict[str, str]


class Launch(Message):
    """A signed authorization: the exact bytes and their signature, both base64.

    One that changes whose hands a session is in (`anew`) begins nothing where that session is over by then.
    """

    type: Literal["launch"] = "launch"
    body: str
    signature: str
    anew: bool = False


class Human(Message):
    """An operator's word on a running session. `resolve_*` answer an escalation the session waits on.

    `let_go` and `end_takeover` are about a session that a human drives: nobody holds its lease any more, or it is done.
    `escalate` is the server's own: another policy is in force, to which the session does not conform. So is a word that
    nobody said (`expired`): `resolve_terminate` or `rollback`, as policy says of a question nobody answers in time.
    """

    type: Literal["human"] = "human"
    invocation: str
    op: Literal[
        "pause", "resume", "stop", "rollback", "cancel", "confirm", "resolve_continue", "resolve_terminate",
        "let_go", "end_takeover", "escalate",
    ]  # fmt: skip
    actor: str
    expired: bool = False

    @property
    def restrains(self) -> bool:
        """Say whether it only holds or ends: it overtakes what waits, and what it overtook may not undo it."""
        return self.op not in GOING_ON


Triple: TypeAlias = tuple[float, float, float]


class Jog(Message):
    """What the human at the controls wants, good for 100 ms of the cell's ticks; only the newest one matters.

    Speeds in the base frame: `base` (vx, vy, wz) in m/s and rad/s, `tool` (vx, vy, vz) in m/s. `lease` is the one it
    comes by: under another than the last, nothing moves before a command of nothing.
    """

    type: Literal["jog"] = "jog"
    invocation: str
    lease: str
    actor: str
    n: int
    base: Triple
    tool: Triple
    grip: Literal["open", "close"] | None = None


class Estop(Message):
    """Emergency stop, category 0, latched."""

    type: Literal["estop"] = "estop"
    actor: str


class Reset(Message):
    """Leave a latched stop, but none that the cell set by itself after the tick `seen`: nobody knew of that.

    Moves nothing. The cell names it in its state once it has heard it.
    """

    type: Literal["reset"] = "reset"
    id: Annotated[str, Field(min_length=1, max_length=64)]
    actor: str
    seen: Count


class SetProfile(Message):
    """The environment profile changed; what runs keeps the profile it was authorized under."""

    type: Literal["profile"] = "profile"
    profile: str


class Ack(Message):
    """Everything up to `seq` is durable in the log."""

    type: Literal["ack"] = "ack"
    seq: int


class Watch(Message):
    """Somebody watches the cell, or nobody does any more; poses go up only while it is `on`."""

    type: Literal["watch"] = "watch"
    on: bool


class Beat(Message):
    """The link is alive. A cell numbers its own; the server's name the newest of those that it has heard."""

    type: Literal["beat"] = "beat"
    n: Count = 0


Down: TypeAlias = Annotated[
    Welcome | Policy | Launch | Human | Jog | Estop | Reset | SetProfile | Ack | Watch | Beat,
    Field(discriminator="type"),
]

# -- up: cell to server ----------------------------------------------------------------------------


class Hello(Message):
    """First word of a cell: who it is, what it holds, and what it was doing.

    `first_seq` is the oldest report that it could still send, `last_seq` the newest there is.
    """

    type: Literal["hello"] = "hello"
    version: int = VERSION
    cell: Short
    boot: Short
    robot: Name
    policy_digest: Short | None
    profile: Short | None
    invocation: Short | None
    latched: bool
    journal: Annotated[str, Field(min_length=1, max_length=64)]  # which file the numbers count in; another, others
    first_seq: Count = 1
    last_seq: Count


class UpEvent(Message):
    """One thing that happened on the cell, in the log's kinds; `at_s` is its wall clock, `tick` its control tick."""

    type: Literal["event"] = "event"
    seq: Count
    at_s: float
    tick: Count
    kind: Name
    invocation: Name | None
    actor: Name
    body: Document


class Sitting(Message):
    """What a session is at, for displays: the skill's phase, what is bound, and why it does not go on if it does not.

    `profile` is the one it was authorized under, which the cell's own may differ from by now. `violated` names the
    watch rules whose condition holds now, `paused_by` the rules that hold the session, and `waits_for` what it asks a
    human about.
    """

    profile: str
    phase: str
    doing: str
    violated: list[str]
    paused_by: list[str]
    waits_for: str


class Jogged(Message):
    """What became of the newest jog command: its number, and the code of why it is not done."""

    n: int
    refused: str | None


class Ended(Message):
    """A session that is over, or a launch that was refused, of which the journal does not say so yet."""

    invocation: str
    outcome: Literal[
        "succeeded", "recovered", "rolled_back", "terminated", "stopped", "cancelled", "taken_over", "fault"
    ]  # fmt: skip
    code: str


class Unrecorded(Message):
    """The cell cannot write its journal, so nothing moves: `why`, and what has `ended` that only this word says."""

    why: str
    ended: list[Ended]


class State(Message):
    """The cell's newest state, ten times a second and on every change."""

    type: Literal["state"] = "state"
    at_s: float
    tick: Count
    invocation: str | None
    status: str | None
    latched: bool
    reset: Annotated[str, Field(max_length=64)] = ""  # the last reset that was heard, whatever came of it
    holding: bool  # the lease lapsed or no welcome yet
    policy_digest: str | None
    profile: str | None
    facts: Document  # a WorldFacts as plain JSON
    gauges: dict[str, float]  # newest watcher signals, for displays
    session: Sitting | None = None
    jog: Jogged | None = None
    fault: Unrecorded | None = None
    broken: str = ""  # what failed of the guard itself; power is cut until a reset
    elsewhere: str = ""  # why nothing is launched under the newest policy: its site is not the robot's


class Scene(Message):
    """What is there to be drawn, once in a link: static bodies, shapes and zones, and the order of pose frames."""

    type: Literal["scene"] = "scene"
    scene: Document
    bodies: list[str]
    gauges: list[str]


class Path(Message):
    """The way the base is planned to go, in metres; empty when there is none. For displays alone."""

    type: Literal["path"] = "path"
    invocation: str | None
    points: list[tuple[float, float]]


class Sighting(Message):
    """Where people and movable things were at a moment of a session, for its telemetry; nothing is decided by it.

    `people` are (number, x, y) as the tracker said and the watcher saw, in metres, in the world frame. `bodies` are the
    poses (x, y, z, qw, qx, qy, qz) of those that moved since the last sighting of the session on this link.
    """

    type: Literal["sighting"] = "sighting"
    invocation: str
    time_s: float
    people: Annotated[list[tuple[Count, float, float]], Field(max_length=64)]
    bodies: Annotated[dict[str, tuple[float, float, float, float, float, float, float]], Field(max_length=256)]


Up: TypeAlias = Annotated[Hello | UpEvent | State | Scene | Path | Sighting | Beat, Field(discriminator="type")]

_DOWN: TypeAdapter[Down] = TypeAdapter(Down)
_UP: TypeAdapter[Up] = TypeAdapter(Up)


class ProtocolError(Exception):
    """A frame that is not a message: says what and why; the link is closed."""


def encode(message: Message) -> str:
    """Return the message as one text frame."""
    return orjson.dumps(message.model_dump(mode="json")).decode()


def decode_down(frame: str | bytes) -> Down:
    """Return the server's message. Raises `ProtocolError`."""
    try:
        return _DOWN.validate_json(frame)
    except ValidationError as error:
        raise _refused(error) from error


def decode_up(frame: str | bytes) -> Up:
    """Return the cell's message. Raises `ProtocolError`."""
    try:
        return _UP.validate_json(frame)
    except ValidationError as error:
        raise _refused(error) from error


def _refused(error: ValidationError) -> ProtocolError:
    return ProtocolError(f"bad message at {first_problem(error)}")


def first_problem(error: ValidationError) -> str:
    """Return where what a cell says is wrong first, and why; of many places, how many."""
    if (count := error.error_count()) > MOST_LISTED:
        return f"`{count}` places: valid is what the protocol says"
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"`{where}`: {first['msg']}"


# -- telemetry: binary frames ----------------------------------------------------------------------

SENSED = (
    "time_s", "base_x_m", "base_y_m", "base_yaw_rad", "base_speed_mps", "tcp_x_m", "tcp_y_m", "tcp_z_m",
    "tcp_speed_mps", "contact_force_n", "peak_force_n", "grip_width_m", "grip_force_n", "slip_m",
    "residual_nm", "separation_m",
    "protective_separation_m", "zone_margin_m", "progress", "rate",
    "q1_rad", "q2_rad", "q3_rad", "q4_rad", "q5_rad", "q6_rad", "base_radius_m",
)  # fmt: skip
HAND = (
    "hand_base_x_mps", "hand_base_y_mps", "hand_base_yaw_radps",
    "hand_tool_x_mps", "hand_tool_y_mps", "hand_tool_z_mps", "hand_grip", "hand_counts",
)  # fmt: skip
"""What a human at the controls asked for: the newest command in the frame of the base, as it came, as long as it is
good; `hand_grip` 1 opens and -1 closes. `hand_counts` is 1 where the robot was told so in that tick, and 0 where
something was in its way. All are 0 where nobody asks for anything."""
CHANNELS = SENSED + HAND
"""Telemetry channels of one control tick, in order, all float32 but the first."""

SENSED_PART = struct.Struct(f"<d{len(SENSED) - 1}f")
HAND_PART = struct.Struct(f"<{len(HAND)}f")
ROW = struct.Struct(f"<d{len(CHANNELS) - 1}f")
HEADER = struct.Struct("<4sHH40s")
_MOST = 3.4028234663852886e38  # of single precision


def single(value: float) -> float:
    """Return a reading as single precision can hold it: what is beyond that is infinite."""
    return math.copysign(math.inf, value) if abs(value) > _MOST else value


_MAGIC = b"RTM1"
ROWS_PER_BATCH = 20
MOST_ROWS = 2048  # of one frame: an alert keeps what came within a second before it, of ticks of 1 ms at the least


def pack_batch(invocation: str, rows: bytes) -> bytes:
    """Return a binary frame of packed rows for an invocation (identifier ≤ 40 ASCII characters)."""
    count, rest = divmod(len(rows), ROW.size)
    if rest:
        raise ProtocolError(f"telemetry of `{len(rows)}` bytes is not a whole number of {ROW.size}-byte rows")
    return HEADER.pack(_MAGIC, count, ROW.size, invocation.encode("ascii")) + rows


def unpack_batch(frame: bytes) -> tuple[str, list[tuple[float, ...]]]:
    """Return invocation and rows of a binary frame. Raises `ProtocolError` on anything malformed."""
    if len(frame) < HEADER.size:
        raise ProtocolError(f"telemetry frame of `{len(frame)}` bytes is shorter than its header ({HEADER.size})")
    magic, count, size, name = HEADER.unpack_from(frame)
    if magic != _MAGIC or size != ROW.size or len(frame) != HEADER.size + count * size:
        raise ProtocolError("telemetry frame does not match its header")
    if count > MOST_ROWS:
        raise ProtocolError(f"telemetry frame of `{count}` rows: valid are `{MOST_ROWS}`")
    if not name.isascii():
        raise ProtocolError("telemetry frame names no invocation: valid are ASCII characters")
    return name.rstrip(b"\0").decode("ascii"), list(ROW.iter_unpack(frame[HEADER.size :]))


# -- poses: binary frames --------------------------------------------------------------------------

POSES = struct.Struct("<4sHHHHIId")
"""Magic, cell, bodies, gauges, reserved, frame, tick, wall clock (s); the server fills in `cell` and `frame`."""

_POSES_MAGIC = b"RPF1"
POSE_BYTES = 7 * 4


def pack_poses(tick: int, at_s: float, poses: bytes, gauges: bytes) -> bytes:
    """Return a binary frame: seven float32 a body (x, y, z, qw, qx, qy, qz), then one a gauge."""
    return POSES.pack(_POSES_MAGIC, 0, len(poses) // POSE_BYTES, len(gauges) // 4, 0, 0, tick, at_s) + poses + gauges


def is_poses(frame: bytes) -> bool:
    """Say whether a binary frame carries poses."""
    return frame.startswith(_POSES_MAGIC)


def measure_poses(frame: bytes) -> tuple[int, int]:
    """Return how many bodies and gauges a frame of poses holds. Raises `ProtocolError` on anything malformed."""
    if len(frame) < POSES.size:
        raise ProtocolError(f"a frame of poses of `{len(frame)}` bytes is shorter than its header ({POSES.size})")
    _, _, bodies, gauges, *_ = POSES.unpack_from(frame)
    if len(frame) != POSES.size + bodies * POSE_BYTES + gauges * 4:
        raise ProtocolError("a frame of poses does not match its header")
    return bodies, gauges


def address_poses(frame: bytes, cell: int, number: int) -> bytes:
    """Return a frame of poses that says which of a console's cells it is of, and its number."""
    addressed = bytearray(frame)
    struct.pack_into("<H", addressed, 4, cell)
    struct.pack_into("<I", addressed, 12, number)
    return bytes(addressed)
