/** `looser`: the new profile allows more, or watches less closely; `different`: that cannot be told. */
export type Way = 'looser' | 'stricter' | 'different';

export interface Difference {
  what: string;
  from: string;
  to: string;
  way: Way;
}

/** Where more of it is looser. */
export const MORE = (from: number, to: number): Way => (to > from ? 'looser' : 'stricter');
/** Where less of it is looser. */
export const FEWER = (from: number, to: number): Way => MORE(to, from);

/** What is looser in one thing is looser, whatever else it is. */
export function together(ways: readonly Way[]): Way {
  return ways.find((way) => way === 'looser') ?? ways.find((way) => way === 'different') ?? 'stricter';
}

/** Named numbers that differ, together; what only one has cannot be compared. */
export function ofNumbers(what: string, from: Readonly<Record<string, number>>, to: Readonly<Record<string, number>>, way: typeof MORE, unit: (name: string, value: number) => string): Difference[] {
  const names = Object.keys(to).filter((name) => from[name] !== undefined && from[name] !== to[name]);
  if (names.length === 0) return [];
  const text = (numbers: Readonly<Record<string, number>>): string => names.map((name) => unit(name, numbers[name] ?? 0)).join(', ');
  return [{ what, from: text(from), to: text(to), way: together(names.map((name) => way(from[name] ?? 0, to[name] ?? 0))) }];
}
