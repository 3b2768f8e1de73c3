import type { Cell, Escalation, Invocation, Json, LogEvent } from '../src/lib/api/documents';
import type { Scene } from '../src/lib/socket/messages';

/** Documents as a server sends them, with what a test is about changed. */
export function escalation(of: Partial<Escalation> = {}): Escalation {
  return {
    id: 'esc_1', invocation: 'inv_1', kind: 'approval', capability: 'grasp_object', agent: 'planner', risk: 'medium',
    reasons: [{ rule: 'human-shared/authority', code: 'approval_required', message: 'medium risk needs approval in human-shared', remedy: '' }],
    requested: { force_n: 80, object_id: 'mug_1', speed_mps: 0.5 },
    effective: { force_n: 60, object_id: 'mug_1', speed_mps: 0.25 },
    digest: 'sha256:1', status: 'pending', approvals: [], needed: 1, expires_at: '2026-11-22T10:02:00.000Z', ...of,
  };
}

export function invocation(of: Partial<Invocation> = {}): Invocation {
  return {
    id: 'inv_1', status: 'running', capability: 'grasp_object', agent: 'planner', cell: 'workcell-1', profile: 'human-shared', policy_version: 'sha256:2',
    requested: { force_n: 80, object_id: 'mug_1', speed_mps: 0.5 }, effective: { force_n: 60, object_id: 'mug_1', speed_mps: 0.25 },
    admission: { outcome: 'accept', reasons: [] },
    policy: {
      outcome: 'modify', reasons: [],
      changes: [
        { param: 'force_n', requested: 80, effective: 60, rule: 'human-shared/grip_force_n' },
        { param: 'speed_mps', requested: 0.5, effective: 0.25, rule: 'human-shared/tcp_speed_mps' },
      ],
    },
    escalation: null, outcome: null, created_at: '2026-11-22T10:00:00.000Z', updated_at: '2026-11-22T10:00:00.000Z', ...of,
  };
}

export function cell(of: Partial<Cell> = {}): Cell {
  return {
    id: 'workcell-1', online: true, latched: false, profile: 'human-shared', busy: 'inv_1', status: 'running', holding_link: false,
    robot: 'mobile-ur5e', policy_version: 'sha256:2', facts: null, gauges: {}, control: null, ...of,
  };
}

/** What a cell says of its session while these hold it. */
export function heldBy(...pausedBy: string[]): NonNullable<Cell['session']> {
  return { phase: null, doing: 'attempt', violated: [], paused_by: pausedBy, waits_for: null };
}

let seq = 0;
export function event(kind: string, body: Record<string, Json>, name: string | null = 'inv_1', actor = 'workcell-1'): LogEvent {
  seq += 1;
  return { seq, at: '2026-11-22T10:00:01.000Z', kind, invocation: name, actor, body };
}

export const scene: Scene = {
  bounds_m: [0, 0, 8, 6],
  zones: [
    { name: 'press_area', kind: 'forbidden', polygon: [[4.6, 0.4], [6.2, 0.4], [6.2, 1.6], [4.6, 1.6]] },
    { name: 'aisle', kind: 'shared', polygon: [[0.9, 2.9], [7.2, 2.9], [7.2, 4.3], [0.9, 4.3]] },
  ],
  shapes: [],
  fixed: {},
};
