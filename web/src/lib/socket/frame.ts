/** One frame of poses: where every moving body of a cell is, and what its gauges read. */
export interface PoseFrame {
  cell: number;
  frame: number;
  tick: number;
  /** The cell's wall clock, seconds. */
  atS: number;
  /** x, y, z, qw, qx, qy, qz per body, in the scene's order. */
  poses: Float32Array;
  /** In the scene's order; NaN: not known. */
  gauges: Float32Array;
}

const MAGIC = 0x31465052; // "RPF1", little endian
const HEADER_BYTES = 28;
const PER_BODY = 7;

/** At which place of the last `watch` a frame's cell stands; null where it is no frame. */
export function placeOf(buffer: ArrayBuffer): number | null {
  return buffer.byteLength < HEADER_BYTES ? null : new DataView(buffer).getUint16(4, true);
}

/** Reads a binary frame. Raises `RangeError` on anything but a whole frame. */
export function readFrame(buffer: ArrayBuffer): PoseFrame {
  if (buffer.byteLength < HEADER_BYTES) throw new RangeError(`a frame of ${buffer.byteLength} bytes has no header`);
  const view = new DataView(buffer);
  if (view.getUint32(0, true) !== MAGIC) throw new RangeError('not a pose frame');
  const bodies = view.getUint16(6, true);
  const gauges = view.getUint16(8, true);
  const numbers = bodies * PER_BODY + gauges;
  if (buffer.byteLength !== HEADER_BYTES + numbers * 4) {
    throw new RangeError(`a frame of ${buffer.byteLength} bytes does not hold ${bodies} bodies and ${gauges} gauges`);
  }
  const values = new Float32Array(numbers);
  for (let k = 0; k < numbers; k += 1) values[k] = view.getFloat32(HEADER_BYTES + k * 4, true);
  return {
    cell: view.getUint16(4, true),
    frame: view.getUint32(12, true),
    tick: view.getUint32(16, true),
    atS: view.getFloat64(20, true),
    poses: values.subarray(0, bodies * PER_BODY),
    gauges: values.subarray(bodies * PER_BODY),
  };
}
