/** Two short tones for a new question, three falling ones for something worse. No sound before the first click or key. */
let context: AudioContext | null = null;

/** Browsers let sound begin with a gesture only. */
export function wakeSound(): void {
  context ??= new AudioContext();
  if (context.state === 'suspended') void context.resume();
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
