import { describe, expect, it } from 'vitest';
import { readFrame } from '../src/lib/socket/frame';

function packed(bodies: number, gauges: number, magic = 'RPF1'): ArrayBuffer {
  const buffer = new ArrayBuffer(28 + bodies * 28 + gauges * 4);
  const view = new DataView(buffer);
  for (let k = 0; k < 4; k += 1) view.setUint8(k, magic.charCodeAt(k));
  view.setUint16(4, 1, true);
  view.setUint16(6, bodies, true);
  view.setUint16(8, gauges, true);
  view.setUint32(12, 77, true);
  view.setUint32(16, 4575, true);
  view.setFloat64(20, 1795308167.05635, true);
  for (let k = 0; k < bodies * 7 + gauges; k += 1) view.setFloat32(28 + k * 4, k / 2, true);
  return buffer;
}

describe('a pose frame', () => {
  it('is read as the server packs it', () => {
    const frame = readFrame(packed(2, 3));
    expect(frame).toMatchObject({ cell: 1, frame: 77, tick: 4575, atS: 1795308167.05635 });
    expect([...frame.poses.slice(7, 9)]).toEqual([3.5, 4]);
    expect([...frame.gauges]).toEqual([7, 7.5, 8]);
  });

  it('is refused when it is cut short, too long or something else', () => {
    expect(() => readFrame(packed(2, 3).slice(0, -4))).toThrow(RangeError);
    expect(() => readFrame(packed(2, 3).slice(0, 20))).toThrow('no header');
    expect(() => readFrame(packed(1, 0, 'RTM1'))).toThrow('not a pose frame');
  });

  it('keeps what is not known as not a number', () => {
    const buffer = packed(0, 1);
    new DataView(buffer).setFloat32(28, NaN, true);
    expect(readFrame(buffer).gauges[0]).toBeNaN();
  });
});
