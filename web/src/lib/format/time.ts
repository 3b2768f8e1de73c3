/** Times in the operator's own zone; durations as a person says them. */
const CLOCK = new Intl.DateTimeFormat('en-GB', { hour: '2-digit', minute: '2-digit', second: '2-digit', hour12: false });
const DAY = new Intl.DateTimeFormat('en-GB', { day: 'numeric', month: 'short', year: 'numeric' });

/** `10:41:37`, from RFC 3339 or ms since the epoch. */
export function clockTime(at: string | number): string {
  const date = new Date(at);
  return Number.isNaN(date.getTime()) ? '–' : CLOCK.format(date);
}

/** `22 Nov 2026, 10:41:37`. */
export function fullTime(at: string | number): string {
  const date = new Date(at);
  return Number.isNaN(date.getTime()) ? '–' : `${DAY.format(date)}, ${CLOCK.format(date)}`;
}

/** Which day it is in the operator's zone. */
export function dayOf(at: string | number): string {
  return DAY.format(new Date(at));
}

/** When something was, for who looks at it on that day: `10:41:37`, and of another day `22 Nov 2026, 10:41:37`. */
export function timeSeenOn(day: string, at: string | number): string {
  return Number.isNaN(new Date(at).getTime()) || dayOf(at) === day ? clockTime(at) : fullTime(at);
}

/** `1:24`, never below `0:00`; a deadline counts whole seconds that are still left. */
export function countdown(leftMs: number): string {
  const seconds = Math.max(0, Math.ceil(leftMs / 1000));
  const hours = Math.floor(seconds / 3600);
  const minutes = Math.floor((seconds % 3600) / 60);
  const rest = String(seconds % 60).padStart(2, '0');
  return hours > 0 ? `${hours}:${String(minutes).padStart(2, '0')}:${rest}` : `${minutes}:${rest}`;
}

/** `0:46`, for what has gone by. */
export function elapsed(ms: number): string {
  return countdown(Math.floor(Math.max(0, ms) / 1000) * 1000);
}

/** `11 min left`, `40 s left`; never more than there is. */
export function left(ms: number): string {
  const seconds = Math.max(0, Math.ceil(ms / 1000));
  return seconds >= 120 ? `${Math.floor(seconds / 60)} min left` : `${seconds} s left`;
}
