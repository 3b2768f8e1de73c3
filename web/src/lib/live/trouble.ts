import type { Cell } from '../api/documents';
import type { Scene } from '../socket/messages';
import { holdersOf } from './control';
import type { Lasting } from './lasting';

export interface SceneTrouble {
  separation: boolean;
  /** The distance that is too small; null where none is. */
  figure: string | null;
  zones: ReadonlySet<string>;
  /** In words, the measured value first, and briefly for where they would cover the picture; null where nothing is wrong. */
  words: { strong: string; text: string; brief: string } | null;
}

const FINE: SceneTrouble = { separation: false, figure: null, zones: new Set(), words: null };

/** Which zones a point of the floor lies in. */
export function zonesAt(scene: Scene, x: number, y: number): string[] {
  return scene.zones.filter((zone) => inside(zone.polygon, x, y)).map((zone) => zone.name);
}

function inside(polygon: readonly (readonly [number, number])[], x: number, y: number): boolean {
  let within = false;
  polygon.forEach(([ax, ay], k) => {
    const [bx, by] = polygon[(k + 1) % polygon.length] ?? [ax, ay];
    if (ay > y !== by > y && x < ax + ((bx - ax) * (y - ay)) / (by - ay)) within = !within;
  });
  return within;
}

export interface Near {
  separationM: number | null;
  neededM: number | null;
  zoneMarginM: number | null;
}

/** What is measured, but of what was too near until a moment ago, as it was then. */
export function lastingOf(near: Near, violations: Lasting<Partial<Near>>, nowMs: number): Near {
  const { separationM, neededM, zoneMarginM } = near;
  const now: Record<string, Partial<Near>> = {};
  if (separationM !== null && neededM !== null && separationM < neededM) now['separation'] = { separationM, neededM };
  if (zoneMarginM !== null && zoneMarginM < 0) now['zone'] = { zoneMarginM };
  return Object.values(violations.take(now, nowMs)).reduce<Near>((all, one) => ({ ...all, ...one }), near);
}

/** What is wrong in the cell now, for the scene and its headline. */
export function troubleOf(cell: Cell | null, near: Near, scene: Scene | null): SceneTrouble {
  if (cell === null) return FINE;
  return tooNear(cell, near) ?? (scene === null ? null : intoZone(cell, near, scene)) ?? FINE;
}

function tooNear(cell: Cell, { separationM, neededM }: Near): SceneTrouble | null {
  if (separationM === null || neededM === null || separationM >= neededM) return null;
  const running = cell.status === 'running';
  const after = running ? '' : afterwards(cell);
  const halted = running ? 'and is being stopped.' : 'and has stopped moving.';
  const needed = `${neededM.toFixed(2)} m`;
  const figure = `${separationM.toFixed(2)} m`;
  return {
    separation: true,
    figure,
    zones: new Set(),
    words: {
      strong: figure,
      text: `to a person. Robot needs ${needed} ${halted}${after}`,
      brief: `to a person, needs ${needed}. ${running ? 'Stopping.' : 'Stopped.'}${after}`,
    },
  };
}

/** What becomes of a robot that the watcher holds: it moves again without anybody's doing. Who drives lets go, and sees. */
function afterwards(cell: Cell): string {
  const { operator, watch } = holdersOf(cell);
  if (cell.control != null) return '';
  if (operator) return ' It waits for Resume, also once they have left.';
  return watch ? ' It goes on by itself once they have left, unless somebody pauses it.' : '';
}

function intoZone(cell: Cell, { zoneMarginM }: Near, scene: Scene): SceneTrouble | null {
  if (zoneMarginM === null || zoneMarginM >= 0) return null;
  const guarded = new Set(scene.zones.filter((zone) => zone.kind !== 'shared').map((zone) => zone.name));
  const [x = 0, y = 0] = cell.facts?.base ?? [];
  const here = zonesAt(scene, x, y).filter((name) => guarded.has(name));
  const zones = new Set(here.length > 0 ? here : guarded);
  const text = `the robot cannot stop outside ${[...zones].join(', ')}.`;
  return { separation: false, figure: null, zones, words: { strong: 'Zone:', text, brief: text } };
}
