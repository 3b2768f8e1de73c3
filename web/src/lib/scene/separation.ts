/**
 * The protective separation as the watcher measures it: how far a person is from the hull, a disc around the base, and
 * from the tool, whichever is less (`separation` in `app/governance/detectors.py`). All of it on the floor, in metres.
 */
export type Spot = readonly [number, number];

export interface Guard {
  base: Spot;
  /** Radius of the hull. */
  hullM: number;
  tool: Spot;
  /** How far people have to be. */
  neededM: number;
}

export interface Gap {
  gapM: number;
  /** Where it is measured from: a point of the hull, or the tool. */
  from: Spot;
  person: Spot;
}

/** A closed line around a place that sees all of it; each point with the way out. */
export interface Loop {
  centre: Spot;
  rim: { at: Spot; out: Spot }[];
}

/** The gauges that a guard is made of, by the names of frames and of telemetry. */
export const MEASURED = { needed: 'protective_separation_m', hull: 'base_radius_m', toolX: 'tcp_x_m', toolY: 'tcp_y_m' } as const;
/** Steps of an arc, whatever its length. */
export const STEPS = 72;
const TURN = 2 * Math.PI;

/** What is kept free around a robot whose base stands somewhere, by its gauges; null where a part of it is not known. */
export function guardAt(base: Spot, yaw: number, gauge: (name: string) => number | null): Guard | null {
  const [neededM, hullM, x, y] = [gauge(MEASURED.needed), gauge(MEASURED.hull), gauge(MEASURED.toolX), gauge(MEASURED.toolY)];
  if (neededM === null || hullM === null || x === null || y === null) return null;
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return { base, hullM, tool: [base[0] + c * x - s * y, base[1] + s * x + c * y], neededM };
}

export function gapTo({ base, hullM, tool }: Guard, person: Spot): Gap {
  const fromHull = apart(base, person) - hullM;
  const fromTool = apart(tool, person);
  if (fromTool <= fromHull) return { gapM: fromTool, from: tool, person };
  return { gapM: fromHull, from: along(base, bearing(base, person), hullM), person };
}

/** The least gap to anybody; null where nobody is. */
export function leastGap(guard: Guard, people: readonly Spot[]): Gap | null {
  return people.map((person) => gapTo(guard, person)).sort((a, b) => a.gapM - b.gapM)[0] ?? null;
}

/** The line at which the gap is what it has to be: around the hull and the tool, as one where both meet. */
export function outline({ base, hullM, tool, neededM }: Guard): Loop[] {
  const around = hullM + neededM;
  const distance = apart(base, tool);
  if (distance <= hullM) return [circle(base, around)];
  if (distance >= around + neededM) return [circle(base, around), circle(tool, neededM)];
  // From the base to the chord that both circles have in common, and half of what each has within the other.
  const chord = (distance ** 2 + around ** 2 - neededM ** 2) / (2 * distance);
  const ahead = bearing(base, tool);
  const within = Math.acos(chord / around);
  const back = Math.acos((distance - chord) / neededM);
  const rim = [
    ...arc(base, around, ahead + within, ahead + TURN - within),
    ...arc(tool, neededM, ahead + Math.PI + back, ahead + Math.PI + TURN - back),
  ];
  return [{ centre: along(base, ahead, chord), rim: rim.concat(rim.slice(0, 1)) }];
}

function circle(centre: Spot, radiusM: number): Loop {
  return { centre, rim: arc(centre, radiusM, 0, TURN) };
}

function arc(centre: Spot, radiusM: number, from: number, to: number): Loop['rim'] {
  return Array.from({ length: STEPS + 1 }, (_, k) => {
    const angle = from + ((to - from) * k) / STEPS;
    return { at: along(centre, angle, radiusM), out: [Math.cos(angle), Math.sin(angle)] as const };
  });
}

function along([x, y]: Spot, angle: number, lengthM: number): Spot {
  return [x + lengthM * Math.cos(angle), y + lengthM * Math.sin(angle)];
}

function bearing([ax, ay]: Spot, [bx, by]: Spot): number {
  return Math.atan2(by - ay, bx - ax);
}

function apart([ax, ay]: Spot, [bx, by]: Spot): number {
  return Math.hypot(bx - ax, by - ay);
}
