import { describe, expect, it } from 'vitest';
import { moved, UNSEEN } from '../src/lib/scene/motion';
import type { PoseFrame } from '../src/lib/socket/frame';

const AT = [1, 2, 0.5, 1, 0, 0, 0];

function frame(poses: number[], gauges: number[] = [0.9, 7]): PoseFrame {
  return { poses: new Float32Array(poses), gauges: new Float32Array(gauges) } as PoseFrame;
}

describe('what is drawn again', () => {
  it('is the first frame, and one of another scene', () => {
    expect(moved(null, frame(AT), [])).toBe(true);
    expect(moved(frame(AT), frame([...AT, ...AT]), [])).toBe(true);
  });

  it('is what moved, however little at a time', () => {
    const drawn = frame(AT);
    const step = UNSEEN * 0.6;
    expect(moved(drawn, frame([1 + step, 2, 0.5, 1, 0, 0, 0]), [])).toBe(false);
    expect(moved(drawn, frame([1 + 2 * step, 2, 0.5, 1, 0, 0, 0]), [])).toBe(true);
  });

  it('is a gauge that is drawn, and no other', () => {
    expect(moved(frame(AT), frame(AT, [0.9, 8]), [0])).toBe(false);
    expect(moved(frame(AT), frame(AT, [0.8, 7]), [0])).toBe(true);
  });

  it('is what came to be known, or is not known any more, once', () => {
    const gone = frame([NaN, 2, 0.5, 1, 0, 0, 0], [NaN, 7]);
    expect(moved(frame(AT), gone, [0])).toBe(true);
    expect(moved(gone, frame(AT), [0])).toBe(true);
    expect(moved(gone, gone, [0])).toBe(false);
    expect(moved(frame(AT), frame(AT), [-1])).toBe(false);
  });
});
