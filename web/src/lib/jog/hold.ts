/** Hold to run: what is held is said again and again, and letting go is said at once. */
export type Axis = 'base_x' | 'base_y' | 'base_yaw' | 'tool_x' | 'tool_y' | 'tool_z';
export type Grip = 'open' | 'close' | null;

export interface Command {
  base: [number, number, number];
  tool: [number, number, number];
  grip: Grip;
}

/** 20 Hz: the server forgets a command after 100 ms, so one may be lost on the way without a stutter. */
export const PERIOD_MS = 50;
const AXES: readonly Axis[] = ['base_x', 'base_y', 'base_yaw', 'tool_x', 'tool_y', 'tool_z'];

/** Top speed per axis, m/s or rad/s. */
export type Speeds = Record<Axis, number>;

/**
 * Turns held keys, pads and sticks into commands at a steady rate.
 *
 * Each source (a key, a pad's button, the gamepad) holds its own deflection in −1…1 and lets go of it alone. The timer is
 * the page's own on purpose: a page that froze falls silent, and a silent console stops the robot.
 */
export class HoldToRun {
  private readonly held = new Map<string, { axis: Axis; deflection: number }>();
  private grip: Grip = null;
  private timer: ReturnType<typeof setInterval> | null = null;

  constructor(
    private readonly send: (command: Command) => void,
    public speeds: Speeds,
  ) {}

  get running(): boolean {
    return this.timer !== null;
  }

  hold(source: string, axis: Axis, deflection: number): void {
    if (deflection === 0) {
      this.release(source);
      return;
    }
    const before = this.held.get(source);
    this.held.set(source, { axis, deflection: Math.max(-1, Math.min(1, deflection)) });
    if (before === undefined) this.start();
  }

  holdGrip(grip: Exclude<Grip, null>): void {
    this.grip = grip;
    this.start();
  }

  releaseGrip(): void {
    this.grip = null;
    this.settle();
  }

  release(source: string): void {
    if (this.held.delete(source)) this.settle();
  }

  /** Lets go of everything: the window lost focus, the lease ended, the page is hidden. */
  releaseAll(): void {
    if (!this.running) return;
    this.held.clear();
    this.grip = null;
    this.settle();
  }

  command(): Command {
    const sum = Object.fromEntries(AXES.map((axis) => [axis, 0])) as Record<Axis, number>;
    for (const { axis, deflection } of this.held.values()) sum[axis] += deflection;
    const at = (axis: Axis): number => Math.max(-1, Math.min(1, sum[axis])) * this.speeds[axis];
    return {
      base: [at('base_x'), at('base_y'), at('base_yaw')],
      tool: [at('tool_x'), at('tool_y'), at('tool_z')],
      grip: this.grip,
    };
  }

  /** Whether what is held asks for any motion: opposite ways ask for none. */
  get moves(): boolean {
    const { base, tool, grip } = this.command();
    return grip !== null || [...base, ...tool].some((speed) => speed !== 0);
  }

  private start(): void {
    this.send(this.command());
    this.timer ??= setInterval(() => this.send(this.command()), PERIOD_MS);
  }

  /** Says what is still held; with nothing left, zeros, at once and for the last time. */
  private settle(): void {
    if (this.timer === null) return;
    if (this.held.size === 0 && this.grip === null) {
      clearInterval(this.timer);
      this.timer = null;
    }
    this.send(this.command());
  }
}
