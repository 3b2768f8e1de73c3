import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';

class FakeAudio {
  static made: FakeAudio[] = [];
  state = 'suspended';
  onstatechange: () => void = () => undefined;
  currentTime = 0;
  destination = {};
  began = 0;
  constructor() {
    FakeAudio.made.push(this);
  }
  asked = 0;
  resume(): Promise<void> {
    this.asked += 1;
    return Promise.reject(new Error('not allowed'));
  }
  createGain(): unknown {
    return { gain: { setValueAtTime() {}, linearRampToValueAtTime() {}, exponentialRampToValueAtTime() {} }, connect: () => ({}) };
  }
  createOscillator(): unknown {
    return { frequency: {}, connect: (next: unknown) => next, start: () => (this.began += 1), stop() {} };
  }
}

describe('the sound of a new question', () => {
  beforeEach(() => {
    vi.resetModules();
    FakeAudio.made = [];
    vi.stubGlobal('AudioContext', FakeAudio);
  });
  afterEach(() => vi.unstubAllGlobals());

  async function sound(active: boolean): Promise<typeof import('../src/lib/alarm/sound.svelte')> {
    vi.stubGlobal('navigator', { userActivation: { hasBeenActive: active } });
    return import('../src/lib/alarm/sound.svelte');
  }

  it('asks the browser for nothing before a gesture', async () => {
    const { wakeSound, playTones, ASKS } = await sound(false);
    wakeSound();
    playTones(ASKS);
    expect(FakeAudio.made).toEqual([]);
  });

  it('bears a refusal, and says nothing until it may', async () => {
    const { wakeSound, playTones, ASKS } = await sound(true);
    wakeSound();
    await Promise.resolve(); // the refusal comes; one that nobody took would fail this test
    const [audio] = FakeAudio.made;
    playTones(ASKS);
    expect(audio?.began).toBe(0);
    if (audio !== undefined) audio.state = 'running';
    playTones(ASKS);
    expect([audio?.began, FakeAudio.made.length]).toEqual([2, 1]);
  });

  it('is asked for again by the next gesture, whatever silenced it', async () => {
    const { wakeSound } = await sound(true);
    wakeSound();
    const [audio] = FakeAudio.made;
    for (const state of ['suspended', 'interrupted', 'running']) {
      if (audio !== undefined) audio.state = state; // `interrupted`: Safari, by a call or while another app is in front
      wakeSound();
    }
    expect(audio?.asked).toBe(3);
  });

  it('is not called on before the browser lets the page sound, and the press that lets it switches nothing off', async () => {
    vi.useFakeTimers();
    const { wakeSound, audible } = await sound(true);
    expect([audible.now, audible.begins]).toEqual([false, true]);
    wakeSound();
    await vi.advanceTimersByTimeAsync(2_000); // a machine without a loudspeaker lets it never
    expect([audible.now, audible.begins]).toEqual([false, false]);
    const [audio] = FakeAudio.made;
    for (const state of ['running', 'suspended']) {
      if (audio !== undefined) audio.state = state;
      audio?.onstatechange();
      expect([audible.now, audible.begins]).toEqual([state === 'running', true]);
      await vi.advanceTimersByTimeAsync(500);
    }
    vi.useRealTimers();
  });
});
