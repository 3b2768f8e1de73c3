/** Two short tones for a new question, three falling ones for something worse. No sound before the first click or key. */
let context: AudioContext | null = null;

/** A press that lets the sound begin is over by then. */
const BEGINS_MS = 1_000;

/** Whether the browser lets this page sound: a page that nobody has pressed anything on is silent, whatever one prefers. */
class Audible {
  now = $state(false);
  private begunMs: number | null = null;

  /** The browser was asked, or has said something else. */
  heed(running: boolean): void {
    if (running || this.begunMs === null) this.begunMs = performance.now();
    this.now = running;
  }

  /** Whether the press that comes now is the one that lets it begin: that one switches nothing off. */
  get begins(): boolean {
    return this.begunMs === null || performance.now() - this.begunMs < BEGINS_MS;
  }
}

export const audible = new Audible();

/** Browsers let sound begin with a gesture only; a finger that has just come down, or Escape, is none yet. */
export function wakeSound(): void {
  const gestures = (navigator as { userActivation?: { hasBeenActive: boolean } }).userActivation;
  if (gestures?.hasBeenActive === false) return;
  context ??= begun();
  // A browser that still refuses is asked again with the next gesture, as is Safari, which a call or another app interrupts;
  // what is said is on screen and read aloud anyway.
  if (context.state !== 'running') context.resume().catch(() => undefined);
}

function begun(): AudioContext {
  const made = new AudioContext();
  made.onstatechange = () => audible.heed(made.state === 'running');
  audible.heed(made.state === 'running');
  return made;
}

export function playTones(frequencies: readonly number[]): void {
  if (context === null || context.state !== 'running') return;
  frequencies.forEach((frequency, k) => tone(context as AudioContext, frequency, k * 0.16));
}

export const ASKS = [660, 880];
export const ALARM = [880, 660, 440];

function tone(audio: AudioContext, frequency: number, delayS: number): void {
  const start = audio.currentTime + delayS;
  const oscillator = audio.createOscillator();
  const volume = audio.createGain();
  oscillator.frequency.value = frequency;
  volume.gain.setValueAtTime(0, start);
  volume.gain.linearRampToValueAtTime(0.18, start + 0.015);
  volume.gain.exponentialRampToValueAtTime(0.001, start + 0.14);
  oscillator.connect(volume).connect(audio.destination);
  oscillator.start(start);
  oscillator.stop(start + 0.15);
}
