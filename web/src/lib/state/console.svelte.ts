import { SvelteMap } from 'svelte/reactivity';
import { Api } from '../api/client';
import type { Capability, Cell, Escalation, InputSchema, Invocation, LogEvent, PolicySet, Review } from '../api/documents';
import { entryOf } from '../format/entry';
import { turnedAway, type Known } from '../format/events';
import { calledOf, lostWords } from '../live/called';
import { Lasting, withLasting } from '../live/lasting';
import { Orders } from '../live/orders.svelte';
import { Reviewing } from '../live/reviewing.svelte';
import { Revoking } from '../live/revoking.svelte';
import { Titles } from '../live/titles.svelte';
import type { Draft } from '../live/decision.svelte';
import { Unheeded } from '../live/unheeded.svelte';
import type { Health } from '../socket/connection';
import type { PoseFrame } from '../socket/frame';
import { Link } from '../socket/link';
import type { Down, Jog } from '../socket/messages';
import { clock, serverMs } from './clock.svelte';
import { fromSnapshot, grantOf, merged, NOTHING, type Documents } from './documents';
import { of, type Path, type SceneInfo } from './drawn';
import { Ends } from './ends.svelte';
import { Lapses } from './lapses.svelte';
import { Pace } from './pace';
import { Quiet } from './quiet';
import { tab } from './tab';

/** `told`: the numbers of this frame are those that are shown as text, everywhere on the page. */
type FrameListener = (frame: PoseFrame, told: boolean) => void;

const OFF: Health = { state: 'connecting', rttMs: null, framesPerS: 0, why: '' };
const LOOK_MS = 1_000;
const QUIET_LOOK_MS = 100;
/** Numbers that change faster are read by nobody. */
const TOLD_MS = 150;
/** What a cell was told it has said itself by then, unless it is not heard; and how often that is looked for. */
const SHOWN_MS = 5_000;
const LOOK_AT_MS = 20;
const POLICY_AGAIN_MS = 2_000;

/**
 * The signed-in console: what the server said, whether that still holds, and which cell is looked at.
 *
 * Poses are not kept here: they go straight to whoever listens with `onFrame`.
 */
export class Console {
  readonly api: Api;
  docs = $state.raw<Documents>(NOTHING);
  health = $state.raw<Health>(OFF);
  me = $state.raw<{ name: string; role: string; station: string | null } | null>(null);
  refused = $state<string | null>(null);
  selected = $state<string | null>(tab.read('reins.cell'));
  /** The question that is open on the page, of whatever cell. */
  asked = $state<string | null>(null);
  /** What the cells that are watched look like: the one that is looked at, and that of an open trace. */
  scenes = $state.raw<Record<string, SceneInfo>>({});
  private paths = $state.raw<Record<string, Path>>({});
  /** Of the cell that is looked at; derived, so that nothing is drawn anew for every document that comes. */
  readonly scene = $derived.by(() => entryOf(this.scenes, this.cell?.id ?? '') ?? null);
  readonly path = $derived.by(() => entryOf(this.paths, this.cell?.id ?? '') ?? null);
  /** What the record of an event leaves to other documents. */
  readonly known: Known = {
    inputs: (id) => this.inputsOf((id === null ? undefined : entryOf(this.docs.invocations, id))?.capability),
    grant: (id) => grantOf(this.docs, id),
    turnedAway: (verdict) => turnedAway(this.docs.events, verdict),
  };
  readonly lapses = new Lapses();
  readonly ends = new Ends();
  readonly unheeded = new Unheeded();
  /** What was typed into questions whose card went before it was sent. */
  readonly drafts = new SvelteMap<string, Draft>();
  /** The question that is open on the page, as it is called, where an edit of it was not sent. */
  editing: string | null = null;
  readonly orders = new Orders(this);
  readonly titles: Titles;
  readonly reviewing: Reviewing;
  readonly revoking: Revoking;
  jogRefused = $state<string | null>(null);
  /** The cell whose controls came when nobody looked at it any more; until whoever asked for them knows. */
  cameLate = $state<string | null>(null);
  /** Whoever sat here has signed out, or was shown out. */
  ended = false;
  /** Cells as asked for by name, while no socket says which there are: the stop needs no seat. */
  private listed = $state.raw<string[]>([]);
  private listing = false;
  policy = $state.raw<PolicySet | null>(null);
  /** Whether that is in force, as far as the server was heard: not before what was asked for anew has come. */
  policyHolds = $state(false);
  capabilities = $state.raw<Record<string, Capability>>({});
  /** Of when what is shown is, server's wall clock in ms. */
  heardAtMs = $state<number | null>(null);

  private readonly link: Link;
  private readonly quiet = new Quiet();
  private quietly = $state(false);
  /** Whether a picture of the cell that is looked at has come since it is looked at. */
  private arrived = $state(false);
  private readonly attending: ReturnType<typeof setInterval>;
  private readonly looking: ReturnType<typeof setInterval>;
  /** Counts the requests for the policy: what an older one brings, or fails of, means nothing any more. */
  private policyTurn = 0;
  private policyAgain: ReturnType<typeof setTimeout> | undefined;
  private frameListeners: readonly FrameListener[] = [];
  private toldMs = -Infinity;
  /** What the server said last; `docs` follows as fast as the page can draw it. */
  private latest: Documents = NOTHING;
  private readonly pace = new Pace(() => this.draw());
  private readonly violations = new Lasting<string>();
  private lapsing: ReturnType<typeof setTimeout> | undefined;

  constructor(token: string) {
    this.api = new Api(token, undefined, () => this.link.heard());
    this.titles = new Titles(this.api);
    this.revoking = new Revoking(this.api);
    this.reviewing = new Reviewing(this.api, () => this.me?.name ?? null, (review) => this.reviewed(review));
    this.link = new Link(token, {
      message: (message, cameMs) => this.take(message, cameMs),
      frame: (frame) => this.show(frame),
      health: (health) => {
        this.health = health;
      },
      refused: (why) => {
        this.refused = why;
      },
      behindMs: () => this.pace.behindMs(),
    });
    this.attending = setInterval(() => {
      this.quietly = this.quiet.look(performance.now());
    }, QUIET_LOOK_MS);
    this.looking = setInterval(() => void this.list(), LOOK_MS);
  }

  private reviewed(review: Review): string {
    return this.titles.of(review) + (this.cells.length > 1 && review.cell !== null ? ` in ${review.cell}` : '');
  }

  /** Whether what is shown may be taken as the present. */
  get live(): boolean {
    return this.health.state === 'up' && this.docs !== NOTHING;
  }

  /** Whether what is shown of the robot may be taken as the present: the server is heard, and hears the cell. */
  get heard(): boolean {
    return this.live && this.cell?.online === true;
  }

  /** Whether poses and gauges may be taken as the present: they stop before the server calls the cell silent. */
  get seen(): boolean {
    return this.heard && this.arrived && !this.quietly;
  }

  get cells(): Cell[] {
    return Object.values(this.docs.cells).sort((a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }));
  }

  get cell(): Cell | null {
    const known = this.selected === null ? undefined : entryOf(this.docs.cells, this.selected);
    return known ?? (this.gone === null ? this.cells[0] : null) ?? null;
  }

  /** The cell that was looked at until the server knew it no more: no other takes its place by itself. */
  get gone(): string | null {
    const { selected } = this;
    return selected !== null && selected === this.met && !Object.hasOwn(this.docs.cells, selected) ? selected : null;
  }

  /** The cell that a stop is for. */
  get stoppable(): string | null {
    const known = this.cell?.id ?? this.gone;
    if (known !== null) return known;
    return this.listed.find((id) => id === this.selected) ?? this.listed[0] ?? null;
  }

  /** The question that is open on the page, where it is about the cell that is looked at. */
  get question(): Escalation | null {
    const asked = this.asked === null ? undefined : entryOf(this.docs.escalations, this.asked);
    if (asked === undefined || this.cell === null) return null;
    return (asked.cell ?? entryOf(this.docs.invocations, asked.invocation)?.cell) === this.cell.id ? asked : null;
  }

  /**
   * What runs in the selected cell, or else what the open question there is about, or else what ran there last; a
   * proposal that policy turned away never ran, but one that waited for a person was on this page until it ended.
   */
  get session(): Invocation | null {
    const cell = this.cell;
    if (cell === null) return null;
    const here = Object.values(this.docs.invocations).filter((invocation) => invocation.cell === cell.id);
    const busy = here.find((invocation) => invocation.id === cell.busy);
    const asked = here.find((invocation) => invocation.id === this.question?.invocation);
    const newest = here.sort((a, b) => b.created_at.localeCompare(a.created_at));
    return busy ?? asked ?? newest.find(({ status, escalation }) => (status !== 'rejected' && status !== 'deferred') || escalation !== null) ?? newest[0] ?? null;
  }

  /** What the parameters of a capability are; of one that is not known, or that nobody named, nothing is. */
  inputsOf(capability: string | undefined): Record<string, InputSchema> {
    return (capability === undefined ? undefined : entryOf(this.capabilities, capability))?.inputs.properties ?? {};
  }

  select(cell: string): void {
    if (cell !== this.selected) this.jogRefused = null; // the cell itself says what still stands
    this.selected = cell;
    this.toldMs = -Infinity;
    tab.write('reins.cell', cell);
    this.watch();
  }

  /** Watches another cell besides the one that is looked at, for its drawing; returns how to end that. */
  watchAlso(cell: string): () => void {
    this.also = cell;
    this.watch();
    return () => {
      this.also = null;
      this.watch();
    };
  }

  /** Hears of every frame of the cell that is looked at. */
  onFrame(listen: FrameListener): () => void {
    this.frameListeners = [...this.frameListeners, listen];
    return () => {
      this.frameListeners = this.frameListeners.filter((known) => known !== listen);
    };
  }

  /** Says the stop on the socket, which waits for no other request; nothing answers there. */
  stop(cell: string): void {
    this.link.send({ type: 'estop', cell });
  }

  /** Comes once a cell is shown to be stopped; without its word, soon enough. */
  async showsStopped(cell: string): Promise<void> {
    for (let waitedMs = 0; waitedMs < SHOWN_MS && entryOf(this.docs.cells, cell)?.latched !== true; waitedMs += LOOK_AT_MS) {
      await new Promise((resolve) => setTimeout(resolve, LOOK_AT_MS));
    }
  }

  /** What whoever leaves has to know of what they typed here; null: nothing. */
  get leaving(): string | null {
    const kept = [...this.drafts.values()].filter(({ asked, sent }) => !sent && asked.id in this.docs.escalations).map(({ asked }) => calledOf(asked, this.docs));
    const lost = this.editing === null ? kept : [this.editing, ...kept];
    const words = [...lostWords('edit of', lost), ...lostWords('note on', this.reviewing.unsent)];
    return words.length === 0 ? null : words.join(' ');
  }

  jog(command: Jog): void {
    this.link.jog(command);
  }

  end(): void {
    this.ended = true;
    clearInterval(this.looking);
    clearInterval(this.attending);
    clearTimeout(this.policyAgain);
    clearTimeout(this.lapsing);
    this.policyTurn += 1;
    this.reviewing.end();
    this.link.end();
  }

  private also: string | null = null;
  private watched: string[] = [];
  /** Of which cell the server told when it was looked at last. */
  private met: string | null = null;
  /** Which of them have been described since: frames before that bear places in an earlier list. */
  private described: string[] = [];

  private watch(): void {
    const first = this.cell?.id ?? null;
    this.met = first ?? this.met;
    const wanted = [first, this.also === first ? null : this.also].filter((cell) => cell !== null);
    if (wanted.join('\n') === this.watched.join('\n')) return;
    if (this.watched.length > 0) this.link.send({ type: 'watch', cells: [] }); // so that all are described anew
    if (wanted[0] !== this.watched[0]) {
      this.quiet.anew();
      this.arrived = false;
    }
    this.watched = wanted;
    this.described = [];
    this.scenes = of(wanted, this.scenes);
    this.paths = of(wanted, this.paths);
    this.link.send({ type: 'watch', cells: wanted });
  }

  private show(frame: PoseFrame): void {
    const cell = this.watched[frame.cell];
    if (cell === undefined || cell !== this.cell?.id || !this.described.includes(cell)) return;
    this.quiet.frame();
    this.quietly = false;
    this.arrived = true;
    const nowMs = performance.now();
    const told = nowMs - this.toldMs >= TOLD_MS;
    if (told) this.toldMs = nowMs;
    this.frameListeners.forEach((listen) => listen(frame, told));
  }

  /** Keeps the news among what was recorded until they are put away. */
  private gather(events: readonly LogEvent[] | undefined): void {
    this.lapses.take(events);
    this.ends.take(events, this.me?.name ?? null);
  }

  private take(message: Down, cameMs: number): void {
    switch (message.type) {
      case 'welcome':
        clock.sync(message.at);
        this.me = { name: message.name, role: message.role, station: message.station };
        break;
      case 'snapshot':
        this.latest = fromSnapshot(message, this.latest);
        this.gather(message.events);
        this.heardAtMs = clock.read();
        this.draw(); // at once: from now on it is the present
        void this.fetchPolicy(); // not before: another may have come into force until then, of which no update will tell
        this.reviewing.resume(this.docs.reviews);
        break;
      case 'update':
        this.latest = merged(this.latest, message);
        this.gather(message.events);
        this.pace.ask(cameMs);
        if (message.events?.some((event) => event.kind === 'policy_activated') === true) void this.fetchPolicy();
        break;
      case 'beat':
        this.heardAtMs = serverMs(message.at);
        if (this.live) clock.sync(message.at); // one that comes late tells the time wrong
        break;
      default:
        this.takeAboutCell(message);
    }
  }

  private draw(): void {
    const nowMs = performance.now();
    clearTimeout(this.lapsing);
    if (this.latest !== NOTHING) this.docs = { ...this.latest, cells: withLasting(this.latest.cells, this.violations, nowMs) };
    this.reviewing.follow(this.docs.reviews);
    const dueMs = this.violations.dueInMs(nowMs);
    if (dueMs !== null) this.lapsing = setTimeout(() => this.pace.ask(), dueMs);
    this.stay();
    if (this.cell !== null) this.watch();
  }

  /** Whoever has chosen no cell, or one that there is not, stays with the one that they see: one that attaches later takes no stop away from it. */
  private stay(): void {
    const seen = this.stoppable;
    if (seen !== null && seen !== this.selected) this.select(seen);
  }

  private takeAboutCell(message: Down): void {
    if (!('cell' in message) || !this.watched.includes(message.cell)) return;
    const { cell } = message;
    switch (message.type) {
      case 'scene':
        this.scenes = { ...this.scenes, [cell]: { scene: message.scene, bodies: message.bodies, gauges: message.gauges } };
        this.paths = of(Object.keys(this.paths).filter((known) => known !== cell), this.paths); // what is planned by now comes behind it
        this.described = [...this.described, cell];
        break;
      case 'path':
        this.paths = { ...this.paths, [cell]: { invocation: message.invocation, points: message.points } };
        break;
      case 'jogged':
        if (cell === this.cell?.id) this.jogRefused = message.refused;
    }
  }

  private async list(): Promise<void> {
    if (this.docs !== NOTHING) {
      clearInterval(this.looking);
      return;
    }
    if (this.listing) return; // a server that does not answer is not asked twice
    this.listing = true;
    try {
      this.listed = (await this.api.cells()).items.map((cell) => cell.id).sort();
      this.stay();
    } catch {
      // asked again in a second; a cell that was there is stopped, whatever became of this question
    }
    this.listing = false;
  }

  private async fetchPolicy(): Promise<void> {
    clearTimeout(this.policyAgain);
    const turn = (this.policyTurn += 1);
    this.policyHolds = false;
    try {
      const [policy, capabilities] = await Promise.all([this.api.policy(), this.api.capabilities()]);
      if (turn !== this.policyTurn) return;
      [this.policy, this.policyHolds] = [policy, true];
      this.capabilities = Object.fromEntries(capabilities.items.map((item) => [item.name, item]));
    } catch {
      if (turn !== this.policyTurn) return;
      // Limits are drawn from it: without it gauges show no limit.
      this.policyAgain = setTimeout(() => void this.fetchPolicy(), POLICY_AGAIN_MS);
    }
  }
}
