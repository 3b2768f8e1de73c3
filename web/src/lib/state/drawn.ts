import type { Scene } from '../socket/messages';

/** What a cell looks like. */
export interface SceneInfo {
  scene: Scene;
  bodies: string[];
  gauges: string[];
}

/** The way that is planned. */
export interface Path {
  invocation: string | null;
  points: [number, number][];
}

/** Of what is known of cells, what is of these. */
export function of<T>(names: readonly string[], all: Record<string, T>): Record<string, T> {
  return Object.fromEntries(Object.entries(all).filter(([name]) => names.includes(name)));
}
