import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';

class FakeAudio {
  static made: FakeAudio[] = [];
  state = 'suspended';
  currentTime = 0;
  destination = {};
  began = 0;
  constructor() {
    FakeAudio.made.push(this);
  }
  resume(): Promise<void> {
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

  async function sound(active: boolean): Promise<typeof import('../src/lib/alarm/sound')> {
    vi.stubGlobal('navigator', { userActivation: { hasBeenActive: active } });
    return import('../src/lib/alarm/sound');
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
});
