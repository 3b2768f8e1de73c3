import type { Cell, Escalation, Params } from '../api/documents';
import { entryOf } from './entry';
import { inBrief, plain } from './plain';

function text(params: Params, name: string): string | null {
  const value = params[name];
  return typeof value === 'string' ? value : null;
}

/** A place to stand is named after what it stands at. */
function place(name: string | null): string {
  return name === null ? 'somewhere' : name.replace(/_stand$/, '');
}

function spot(params: Params): string {
  const { x_m: x, y_m: y } = params;
  if (typeof x === 'number' && typeof y === 'number') return `${x.toFixed(1)}, ${y.toFixed(1)}`;
  return place(text(params, 'target'));
}

const SENTENCES: Record<string, (params: Params, held: string) => string> = {
  navigate_to: (params) => `Drive to ${spot(params)}`,
  inspect_area: (params) => `Look over ${text(params, 'area') ?? 'an area'}`,
  grasp_object: (params) => `Grasp ${text(params, 'object_id') ?? 'an object'}`,
  place_object: (params, held) => `Put ${held} on ${text(params, 'surface') ?? 'a surface'}`,
  transport_object: (params, held) => `Carry ${held} to ${spot(params)}`,
  operate_tool: (params) => `${words(text(params, 'action') ?? 'operate')} at the ${text(params, 'tool') ?? 'tool'}`,
  takeover: () => 'Drive by hand',
};

export function words(name: string): string {
  const spaced = plain(name).replaceAll('_', ' ');
  return spaced.charAt(0).toUpperCase() + spaced.slice(1);
}

/** Of a capability that only its own policy knows: what it is called, and the things and places that it names. */
function named(capability: string, params: Params): string {
  const names = Object.keys(params).sort().map((name) => text(params, name)).filter((name) => name !== null && name !== '');
  return names.length === 0 ? words(capability) : `${words(capability)}: ${inBrief(names.join(', '))}`;
}

/** What a proposal would do, as a short sentence: `Carry glass_1 to bench_b`, `Polish lens: lens_2`. */
export function titleOf(capability: string, params: Params, holding: string | null = null): string {
  return plain(entryOf(SENTENCES, capability)?.(params, holding ?? 'what it holds') ?? named(capability, params));
}

/** What the gripper of a cell holds, as far as that is known: of the cell in question, which need not be the one looked at. */
export function heldIn(cells: Record<string, Cell>, cell: string | null | undefined): string | null {
  return (cell == null ? undefined : entryOf(cells, cell))?.facts?.holding ?? null;
}

/** What a question is about, where that is what the gripper holds: as it was asked, whatever has come into the gripper since. */
export function loadOf({ carried, cell }: Pick<Escalation, 'carried' | 'cell'>, cells: Record<string, Cell>): string | null {
  return carried ?? heldIn(cells, cell);
}
