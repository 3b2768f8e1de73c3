import { render } from 'svelte/server';
import { expect, it } from 'vitest';
import EventLog from '../src/components/live/EventLog.svelte';
import Name from '../src/components/parts/Name.svelte';
import type { Console } from '../src/lib/state/console.svelte';
import { NOTHING } from '../src/lib/state/documents';
import InConsole from './InConsole.svelte';
import { event } from './samples';

it('has a sentence of its own run its own way, whatever name it begins with, and other words as they begin', () => {
  const denied = event('policy', { outcome: 'deny', reasons: [{ message: '`כוס_1` is in a forbidden zone' }] });
  const console = { docs: { ...NOTHING, events: [denied] }, session: null, cell: null } as unknown as Console;
  const { body } = render(InConsole, { props: { console, What: EventLog } });
  expect(body.replace(/<!--.*?-->|<wbr\/?>/g, '')).toContain('<bdi dir="ltr">כוס_1 is in a forbidden zone</bdi>');
  expect(render(Name, { props: { text: 'כוס' } }).body).toContain('<bdi dir="auto">');
});
