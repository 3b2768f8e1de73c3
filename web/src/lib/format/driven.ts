import type { Json } from '../api/documents';
import { number } from './quantity';

const WAYS: readonly (readonly [string, string])[] = [['forward', 'back'], ['left', 'right'], ['up', 'down']];

/** What a human at the controls asks for, in words: what moves, how fast and which way, as seen by the robot. */
export function driven(body: Readonly<Record<string, Json>>): string {
  const [base, tool] = [speeds(body['base']), speeds(body['tool'])];
  const turn = base[2] ?? 0;
  const parts = [
    moved('base', base.slice(0, 2)),
    turn === 0 ? '' : `turn ${turn > 0 ? 'left' : 'right'} ${number(Math.abs(turn), 'rad/s')} rad/s`,
    moved('tool', tool),
    body['grip'] === 'open' || body['grip'] === 'close' ? `${body['grip']} the gripper` : '',
  ].filter((part) => part !== '');
  return parts.length === 0 ? 'is let go of' : `is driven by hand: ${parts.join(', ')}`;
}

function speeds(said: Json | undefined): number[] {
  return Array.isArray(said) ? said.map((value) => (typeof value === 'number' ? value : 0)) : [];
}

function moved(what: string, along: readonly number[]): string {
  const ways = along.flatMap((speed, axis) => (speed === 0 ? [] : [WAYS[axis]?.[speed > 0 ? 0 : 1] ?? '']));
  return ways.length === 0 ? '' : `${what} ${ways.join(' and ')} ${number(Math.hypot(...along), 'm/s')} m/s`;
}
