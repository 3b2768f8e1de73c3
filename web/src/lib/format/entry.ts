/**
 * What a table holds under a name that an agent or the server chose: only what was put there, and nothing of what every
 * object brings along (`constructor`, `toString`).
 */
export function entryOf<T>(table: Readonly<Record<string, T>>, name: string): T | undefined {
  return Object.hasOwn(table, name) ? table[name] : undefined;
}
