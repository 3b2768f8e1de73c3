import { afterEach, describe, expect, it, vi } from 'vitest';
import type { InputSchema, LogEvent, Telemetry } from '../src/lib/api/documents';
import { Axis } from '../src/lib/audit/axis';
import { Player, type Recording } from '../src/lib/audit/player.svelte';
import { authorizedAlong, authorizedOf, boundAt, frameAt, topOf, TRACES, tracesOf, unheeded, valuesOf } from '../src/lib/audit/replay';
import { guardAt, MEASURED } from '../src/lib/scene/separation';
import { aheadOf, beginningOf, eventAt, goodForS, measuredAt, offset, outside, partsOf, rowAt, stepTo, timelineOf } from '../src/lib/audit/timeline';

const START_MS = Date.parse('2026-03-01T09:30:00.000Z');
const event = (seq: number, afterS: number, body: LogEvent['body'] = {}): LogEvent => ({
  seq, at: new Date(START_MS + afterS * 1000).toISOString(), kind: 'alert', invocation: 'inv_1', actor: 'x',
  body: body['tick'] === undefined ? body : { cell_at_s: START_MS / 1000 + afterS, ...body },
});
const telemetry = (columns: Telemetry['columns']): Telemetry => ({
  invocation: 'inv_1', part: 1, parts: 1, file: 'f', sha256: 's', intact: true, start_at: '', rows: 3, every: 1, units: {}, columns,
  people: { time_s: [], tracks: [] }, bodies: {},
});
const ROWS = telemetry({ time_s: [10, 12, 20] });

describe('a timeline', () => {
  it('puts what the cell says at its tick, whatever pace the simulation ran at', () => {
    // Ten seconds of the cell's time within one second of wall time.
    const found = timelineOf([event(1, 5, { tick: 1000 }), event(2, 6, { tick: 2000 })], ROWS);
    expect(found.placed.map(({ atS }) => atS)).toEqual([0, 10]);
    expect(found.toS).toBe(10);
  });

  it('begins with the launch whatever the clock of its robot says: the first row is of the tick behind it', () => {
    const found = timelineOf([{ ...event(1, 5, { tick: 132 }), kind: 'launch' }, event(2, 5.3, { tick: 167 })], telemetry({ time_s: [1.73, 1.78, 2.07] }));
    expect(found.placed.map(({ atS }) => Math.round(atS * 100) / 100)).toEqual([-0.01, 0.34]);
  });

  it('keeps to the clock of its robot in every part of its telemetry, once the first row of all was read', () => {
    const launch = { ...event(1, 5, { tick: 132 }), kind: 'launch' };
    const kept = (seq: number, body: LogEvent['body']): LogEvent => ({ ...event(seq, 6, body), kind: 'telemetry' });
    const [first, second] = [telemetry({ time_s: [1.73, 1.78] }), { ...telemetry({ time_s: [3.73, 3.78] }), part: 2 }];
    const whole = [launch, kept(2, { rows: 2 }), event(3, 7, { tick: 333 }), kept(4, { rows: 2 })];
    const aheadS = aheadOf(whole, first) ?? NaN;
    expect([aheadS, aheadOf(whole, second)]).toEqual([expect.closeTo(0.4), null]);
    expect(timelineOf(whole, second, aheadS).placed.map(({ atS }) => Math.round(atS * 100) / 100)).toEqual([-2.01, -1.01, 0, 0]);
    const late = [launch, kept(2, { rows: 0 }), kept(3, { rows: 2 })];
    expect([whole, late, [launch, kept(2, { failed: 'no room' }), kept(3, { rows: 2 })], [launch]].map(beginningOf)).toEqual([1, 2, 1, 1]);
    expect(aheadOf(late, { ...first, part: 2 })).toBeCloseTo(0.4);
  });

  it('puts what only the server says in proportion between its neighbours', () => {
    const found = timelineOf([event(1, 5, { tick: 1000 }), event(2, 5.5), event(3, 6, { tick: 2000 })], ROWS);
    expect(found.placed[1]?.atS).toBeCloseTo(5);
    expect(found.placed[1]?.exact).toBe(false);
  });

  it('begins before the first row with what was decided before it', () => {
    const found = timelineOf([event(1, 2), event(2, 5, { tick: 1000 })], ROWS);
    expect(found.fromS).toBeCloseTo(-3);
    expect(offset(found.fromS)).toBe('−3.0 s');
  });

  it('never runs backwards along the record', () => {
    const found = timelineOf([event(1, 5, { tick: 1000 }), event(2, 6, { tick: 2000 }), event(3, 5.2)], ROWS);
    expect(found.placed.map(({ atS }) => atS)).toEqual([0, 10, 10]);
  });

  it('is the wall clock alone where nothing ran', () => {
    const found = timelineOf([event(1, 2), event(2, 2.5)], null);
    expect(found.placed.map(({ atS }) => atS)).toEqual([0, 0.5]);
    expect(rowAt(null, found.zeroS, 0.5)).toBe(-1);
  });

  it('finds the newest row and event at a moment', () => {
    const found = timelineOf([event(1, 5, { tick: 1000 }), event(2, 6, { tick: 2000 })], ROWS);
    expect([-1, 0, 1.9, 2, 99].map((at) => rowAt(ROWS, found.zeroS, at))).toEqual([0, 0, 0, 1, 2]);
    expect([-1, 0, 9.9, 10].map((at) => eventAt(found.placed, at))).toEqual([-1, 0, 0, 1]);
  });

  it('finds of what was recorded within a moment the last, or what was picked of it', () => {
    const { placed } = timelineOf([event(1, 5), event(2, 5), event(3, 5), event(4, 6)], null);
    expect([null, 1, 2, 3, 4, 9].map((picked) => eventAt(placed, 0, picked))).toEqual([2, 0, 1, 2, 2, 2]);
    expect([eventAt(placed, 0.5, 1), eventAt(placed, 1, 1), eventAt(placed, -1, 1), eventAt([], 0, 1)]).toEqual([2, 3, -1, -1]);
  });

  it('steps from event to event and stays within its ends', () => {
    const found = timelineOf([event(1, 5, { tick: 1000 }), event(2, 6, { tick: 1500 })], ROWS);
    expect([stepTo(found, 0, 1), stepTo(found, 5, 1), stepTo(found, 10, 1)]).toEqual([5, 10, 10]);
    expect([stepTo(found, 7, -1), stepTo(found, 5, -1), stepTo(found, 0, -1)]).toEqual([5, 0, 0]);
  });
});

/** Asked at 0 s, launched two minutes later, stopped half a second after its first row, reviewed ten seconds later. */
const REVIEWED = [
  { ...event(1, 0), kind: 'proposal' },
  { ...event(2, 0.5), kind: 'escalation' },
  { ...event(3, 119.5, { refused: 'stale' }), kind: 'launch' },
  { ...event(4, 120, { tick: 999 }), kind: 'launch' },
  { ...event(5, 120.7, { tick: 1050 }), kind: 'outcome' },
  { ...event(6, 130.7), kind: 'review' },
];
const HALF_A_SECOND = telemetry({ time_s: Array.from({ length: 61 }, (_, k) => 10 + k / 100), separation_m: Array.from({ length: 61 }, () => 2) });

describe('what a timeline gives room to', () => {
  const found = timelineOf(REVIEWED, HALF_A_SECOND);

  it('is what ran, from its launch to its last row, whatever a person took before or after it', () => {
    expect([found.axis.fromS, found.axis.toS, found.axis.length].map((at) => Math.round(at * 100) / 100)).toEqual([-0.01, 0.6, 0.61]);
    expect([found.axis.place(-120), found.axis.place(10.5)]).toEqual([0, found.axis.length]);
    expect([outside(found, -1), outside(found, 0), outside(found, 0.6), outside(found, 0.7)]).toEqual(['before the launch', '', '', 'after the end']);
  });

  it('keeps the moment of everything else, which is stepped to and named', () => {
    expect([found.fromS, found.toS].map(Math.round)).toEqual([-120, 11]);
    const steps = [found.fromS];
    for (let k = 0; k < 7; k += 1) steps.push(stepTo(found, steps.at(-1) ?? 0, 1));
    expect(steps.map((at) => eventAt(found.placed, at))).toEqual([0, 1, 2, 3, 4, 5, 5, 5]);
    expect(eventAt(found.placed, stepTo(found, found.toS, -1))).toBe(4);
  });

  it('goes on to the newest event where nothing has ended, and is all there is where nothing ran', () => {
    expect(timelineOf(REVIEWED.slice(0, 4), null).axis.toS).toBeCloseTo(0);
    const denied = timelineOf([...REVIEWED.slice(0, 2), { ...event(3, 4), kind: 'outcome' }, { ...event(4, 99), kind: 'review' }], null);
    expect([denied.axis.fromS, denied.axis.toS]).toEqual([0, 4]);
  });
});

describe('a reading', () => {
  const gap = telemetry({ time_s: [0, 0.01, 0.02, 0.03, 2, 2.01, 2.02], separation_m: [1, 1, 1, 1, 3, 3, 3] });
  const at = (moment: number): boolean => measuredAt(gap, rowAt(gap, 0, moment), 0, moment, goodForS(gap));

  it('is one of its moment alone: there is none in a gap, before the first row or after the last', () => {
    expect([-0.01, 0, 0.03, 0.1, 0.2, 1.9, 2, 2.1, 2.2].map(at)).toEqual([false, true, true, true, false, false, true, true, false]);
    expect(measuredAt(null, -1, 0, 0, 1)).toBe(false);
  });

  it('stands for as long as rows are apart that are drawn one in many', () => {
    expect(goodForS(telemetry({ time_s: [0, 2, 4, 6] }))).toBe(6);
    expect(goodForS({ ...telemetry({ time_s: [0, 0.1, 0.2, 0.3, 0.8] }), every: 10 })).toBe(1);
  });

  it('draws no line through a gap', () => {
    const drawn = new Axis(0, 3).drawn([0, 0.01, 0.02, 0.03, 2, 2.01, 2.02], [[1, 1, 1, 1, 3, 3, 3]], goodForS(gap));
    expect(drawn.columns).toEqual([[1, 1, 1, 1, null, 3, 3, 3]]);
  });

  it('leaves of a moment without one only where things stood', () => {
    const row = telemetry({
      time_s: [1], base_x_m: [2], base_y_m: [3], base_yaw_rad: [0], q1_rad: [0], q2_rad: [0], q3_rad: [0], q4_rad: [0], q5_rad: [0], q6_rad: [0], tcp_speed_mps: [0.25],
    });
    const [read, stood] = [true, false].map((measured) => frameAt(row, 0, ['base'], ['tcp_speed_mps'], measured));
    expect([read?.gauges[0], stood?.gauges[0]]).toEqual([0.25, NaN]);
    expect(stood?.poses).toEqual(read?.poses);
  });
});

describe('a recorded moment in the scene', () => {
  const full = telemetry({
    time_s: [1], base_x_m: [2], base_y_m: [3], base_yaw_rad: [0], q1_rad: [0], q2_rad: [0], q3_rad: [0], q4_rad: [0], q5_rad: [0], q6_rad: [0],
    separation_m: [99], tcp_speed_mps: [0.25],
  });

  it('places the robot and leaves people and objects out', () => {
    const frame = frameAt(full, 0, ['base', 'mug_1', 'person_1_torso'], ['separation_m', 'tcp_speed_mps']);
    expect([...(frame?.poses.slice(0, 3) ?? [])]).toEqual([2, 3, 0]);
    expect([...(frame?.poses.slice(7) ?? [])].every(Number.isNaN)).toBe(true);
    expect(frame?.gauges[0]).toBeNaN(); // 99 m stands for nobody
    expect(frame?.gauges[1]).toBeCloseTo(0.25);
  });

  it('says what separation was measured from, as a frame of the present does', () => {
    const held = telemetry({ ...full.columns, protective_separation_m: [0.75], base_radius_m: [0.5], tcp_x_m: [0.5], tcp_y_m: [-0.25] });
    const names = Object.values(MEASURED);
    const frame = frameAt(held, 0, ['base'], names);
    expect(guardAt([2, 3], 0, (name) => frame?.gauges[names.findIndex((one) => one === name)] ?? null)).toEqual({ base: [2, 3], hullM: 0.5, tool: [2.5, 2.75], neededM: 0.75 });
  });

  it('shows people where the tracker saw them, and things where they were last put', () => {
    const recorded: Telemetry = {
      ...full,
      people: { time_s: [0.8, 1], tracks: [[[1, 5, 5]], [[1, 4.5, 5], [2, 1, 1]]] },
      bodies: { mug_1: { time_s: [0, 0.9, 2], pose: [[0, 0, 1, 1, 0, 0, 0], [1, 2, 0.9, 1, 0, 0, 0], [9, 9, 9, 1, 0, 0, 0]] } },
    };
    const names = ['person_1_torso', 'person_1_leg_left', 'person_2_torso', 'person_3_torso', 'mug_1'];
    const at = (row: number, k: number): number[] => [...(frameAt(recorded, row, names, [])?.poses.slice(k * 7, k * 7 + 2) ?? [])];
    const row = 0;
    expect([at(row, 0), at(row, 1), at(row, 2), at(row, 4)]).toEqual([[4.5, 5], [4.5, 5], [1, 1], [1, 2]]);
    expect(at(row, 3).every(Number.isNaN)).toBe(true);
  });

  it('forgets whom nobody has seen for half a second', () => {
    const gone: Telemetry = { ...full, people: { time_s: [0.4], tracks: [[[1, 5, 5]]] } };
    const poses = frameAt(gone, 0, ['person_1_torso'], [])?.poses;
    expect([...(poses ?? [])].every(Number.isNaN)).toBe(true);
  });

  it('shows at the first moment what the record holds of the next, and no later thing', () => {
    const begun: Telemetry = {
      ...full,
      people: { time_s: [1.2], tracks: [[[1, 5, 5]]] },
      bodies: { mug_1: { time_s: [1.1], pose: [[1, 2, 0.9, 1, 0, 0, 0]] }, box_2: { time_s: [1.6], pose: [[3, 3, 0.9, 1, 0, 0, 0]] } },
    };
    const poses = frameAt(begun, 0, ['person_1_torso', 'mug_1', 'box_2'], [])?.poses ?? [];
    expect([poses[0], poses[7], poses[14]]).toEqual([5, 1, NaN]);
  });

  it('is not made up where a part of the posture is missing', () => {
    expect(frameAt(telemetry({ ...full.columns, q3_rad: [null] }), 0, ['base'], [])).toBeNull();
  });
});

describe('telemetry', () => {
  const trace = (...kinds: string[]): LogEvent[] => kinds.map((kind, seq) => ({ seq, at: '2026-11-22T10:00:00Z', kind, invocation: 'inv_1', actor: 'server', body: {} }));

  it('is asked for where the trace tells of it, in as many parts, and nowhere else', () => {
    expect(partsOf(trace('proposal', 'outcome', 'telemetry'))).toBe(1);
    expect(partsOf(trace('proposal', 'telemetry', 'outcome', 'telemetry'))).toBe(2);
    expect(partsOf(trace('proposal', 'outcome'))).toBe(0);
  });
});

describe('a player', () => {
  afterEach(() => vi.unstubAllGlobals());

  it('stays where it was put while the record grows, and within it', () => {
    vi.stubGlobal('cancelAnimationFrame', () => undefined);
    const player = new Player();
    player.load(recording(new Axis(0, 10)), 4);
    player.grow(recording(new Axis(-1, 20)));
    expect(player.atS).toBe(4);
    player.seek(-5);
    expect(player.atS).toBe(-1);
    player.grow(recording(new Axis(0, 3)));
    player.seek(9);
    expect(player.atS).toBe(3);
  });

  it('plays what ran, wherever it is told to go on from', () => {
    const frames: FrameRequestCallback[] = [];
    vi.stubGlobal('cancelAnimationFrame', () => undefined);
    vi.stubGlobal('requestAnimationFrame', (next: FrameRequestCallback) => frames.push(next));
    const player = new Player();
    player.load({ axis: new Axis(0, 10), fromS: -120, toS: 60 }, 0);
    for (const looked of [60, -120]) {
      player.seek(looked);
      expect(player.atS).toBe(looked);
      player.play();
      draw(frames, 0, 1000);
      expect(player.atS).toBeCloseTo(1);
      player.pause();
    }
  });

  it('passes a long wait as fast as it is drawn', () => {
    const frames: FrameRequestCallback[] = [];
    vi.stubGlobal('cancelAnimationFrame', () => undefined);
    vi.stubGlobal('requestAnimationFrame', (next: FrameRequestCallback) => frames.push(next));
    const player = new Player();
    player.load(recording(ASKED), -905);
    player.play();
    draw(frames, 0, 10_000);
    expect(player.atS).toBeCloseTo(3.74); // 5 s to scale, 1.26 s for 15 minutes, 3.74 s to scale
    draw(frames, 10_000, 40_000);
    expect([player.atS, player.playing]).toEqual([16, false]);
  });

  it('goes on from what was last seen when its tab was hidden or the machine slept', () => {
    const frames: FrameRequestCallback[] = [];
    vi.stubGlobal('cancelAnimationFrame', () => undefined);
    vi.stubGlobal('requestAnimationFrame', (next: FrameRequestCallback) => frames.push(next));
    const player = new Player();
    player.load(recording(new Axis(0, 10)), 0);
    player.play();
    draw(frames, 0, 1000);
    draw(frames, 9000, 10_000);
    expect([player.atS, player.playing]).toEqual([expect.closeTo(2), true]);
  });
});

/** Draws a frame every tenth of a second. */
function draw(frames: FrameRequestCallback[], fromMs: number, toMs: number): void {
  for (let ms = fromMs; ms <= toMs; ms += 100) frames.at(-1)?.(ms);
}

const recording = (axis: Axis): Recording => ({ axis, fromS: axis.fromS, toS: axis.toS });

/** Asked within 5 s, answered a quarter of an hour later, run for 16 s. */
const ASKED = new Axis(-905, 16, [-903, -900, 0, ...Array.from({ length: 160 }, (_, k) => k / 10)]);

describe('an axis', () => {
  it('is to scale where no wait is long', () => {
    const axis = new Axis(-10, 20, [3, 12]);
    expect([axis.length, axis.folds.length]).toEqual([30, 0]);
    expect([axis.place(-10), axis.place(5), axis.place(20)]).toEqual([0, 15, 30]);
    expect([axis.at(0), axis.at(15), axis.at(30)]).toEqual([-10, 5, 20]);
  });

  it('gives a long wait in which nothing was recorded a little room, however long it was', () => {
    expect(ASKED.folds).toHaveLength(1);
    expect(ASKED.length).toBeCloseTo(5 + 1.26 + 16);
    expect(ASKED.place(0) - ASKED.place(-900)).toBeCloseTo(1.26);
    expect(ASKED.place(16) - ASKED.place(0)).toBeCloseTo(16);
    expect(ASKED.folds[0]).toMatchObject({ fromS: -900, toS: 0 });
    expect(ASKED.folds[0]?.left).toBeCloseTo(5 / ASKED.length);
  });

  it('leads from a moment to its place and back, everywhere, and never backwards', () => {
    const places = Array.from({ length: 922 }, (_, k) => ASKED.place(k - 905));
    places.forEach((place, k) => expect(ASKED.at(place)).toBeCloseTo(k - 905, 4));
    expect(places.every((place, k) => k === 0 || place > (places[k - 1] ?? 0))).toBe(true);
    expect([ASKED.at(-1), ASKED.at(999), ASKED.place(-9999), ASKED.place(9999)]).toEqual([-905, 16, 0, ASKED.length]);
  });

  it('folds nothing where a wait is all there is', () => {
    const axis = new Axis(0, 600, [0, 600]);
    expect([axis.folds.length, axis.place(300)]).toEqual([0, 300]);
    expect(new Axis(0, 0).place(0)).toBe(0);
  });

  it('draws no line through what was not recorded', () => {
    const axis = new Axis(0, 120, [0, 1, 2, 100, 110, 120]);
    const drawn = axis.drawn([0, 1, 2, 100, 110, 120], [[1, 2, 3, 4, 5, 6]]);
    expect(drawn.columns).toEqual([[1, 2, 3, null, 4, 5, 6]]);
    expect(drawn.times).toHaveLength(7);
    expect(drawn.times.every((at, k) => k === 0 || at > (drawn.times[k - 1] ?? 0))).toBe(true);
  });
});

describe('a plot', () => {
  const contact = TRACES.find(({ channel }) => channel === 'contact_force_n') ?? TRACES[0];

  it('is drawn in a scale that noise does not fill, and that all of it fits in', () => {
    if (contact === undefined) throw new Error('nothing is drawn');
    expect([topOf(contact, [0.3, null, 2]), topOf(contact, []), topOf(contact, [1], [60])]).toEqual([25, 25, 66]);
  });

  it('is there of what a human asked for by hand, only where one did, and says where it was not done', () => {
    const rest = { hand_base_x_mps: [0, 0, 0], hand_base_y_mps: [0, 0, 0], hand_base_yaw_radps: [0, 0, 0], hand_tool_x_mps: [0, 0, 0], hand_tool_y_mps: [0, 0, 0], hand_tool_z_mps: [0, 0, 0], hand_counts: [0, 0, 0] };
    const driven = telemetry({ time_s: [0, 1, 2], ...rest, hand_base_x_mps: [0, 0.3, null], hand_base_y_mps: [0, -0.4, 0], hand_base_yaw_radps: [0, 0, -0.2] });
    expect([tracesOf(telemetry({ time_s: [0, 1, 2], ...rest })), tracesOf(ROWS)]).toEqual([[], []]);
    expect(tracesOf(driven).map(({ channel }) => [channel, valuesOf(driven, channel)])).toEqual([['hand_base', [0, 0.5, null]], ['hand_turn', [0, 0, 0.2]]]);
    const counted = { ...driven, columns: { ...driven.columns, hand_counts: [0, 0, 1] } };
    expect([0, 1, 2].map((row) => [unheeded(counted, 'hand_base', row), unheeded(counted, 'hand_turn', row)])).toEqual([[false, false], [true, false], [false, false]]);
  });

  it('has the line that was authorized where a parameter falls under a limit of its name', () => {
    const inputs = { speed_mps: { 'x-limit': 'base_speed_mps' }, clearance_m: {}, target: { 'x-limit': 'tcp_speed_mps' } };
    expect(authorizedOf({ speed_mps: 0.3, clearance_m: 0.3, target: 'dock', constructor: 1 }, inputs)).toEqual({ base_speed_mps: 0.3 });
  });

  it('has the line of what moves the robot then: of a recovery, of who drives it, and of the attempt that follows', () => {
    const limits: Record<string, string> = { navigate_to: 'base_speed_mps', reposition_base: 'base_speed_mps', grasp_object: 'tcp_speed_mps' };
    const under = (capability: string, speed: number): LogEvent['body'] => ({ capability, params: { speed_mps: speed } });
    const anew: LogEvent['body'] = { reason: 'new_attempt' };
    const told: [string, LogEvent['body']][] = [
      ['launch', { ...under('navigate_to', 0.9), refused: 'busy' }],
      ['launch', under('navigate_to', 0.3)],
      ['recovery', { ...under('reposition_base', 0.15), strategy: 'RECOVERY_CAPABILITY' }],
      ['status', anew],
      ['recovery', { ...under('navigate_to', 0.2), strategy: 'SAFER_MODE' }],
      ['status', anew],
      ['recovery', { strategy: 'ASK_HUMAN', capability: null, params: {} }],
      ['recovery', { strategy: 'RETRY' }], // somebody let it try again
      ['status', anew],
      ['recovery', { ...under('retrace', 0.15), strategy: 'ROLLBACK' }], // which falls under no one limit
      ['launch', under('grasp_object', 0.1)],
    ];
    const { placed } = timelineOf(told.map(([kind, body], k) => ({ ...event(k, k), kind, body })), null);
    const along = authorizedAlong(placed, (capability) => ({ speed_mps: { 'x-limit': limits[capability] } }) as Record<string, InputSchema>);
    expect(placed.map(({ atS }) => boundAt(along, 'base_speed_mps', atS))).toEqual([null, 0.3, 0.15, 0.3, 0.2, 0.2, 0.2, 0.2, 0.3, null, null]);
    expect([boundAt(along, 'base_speed_mps', 2.5), boundAt(along, 'tcp_speed_mps', 10)]).toEqual([0.15, 0.1]);
  });
});
