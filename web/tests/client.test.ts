import { describe, expect, it } from 'vitest';
import { Api, refusedWords, UNTOLD } from '../src/lib/api/client';

/** A server that answers nothing until it is told to; and, as a browser, gives up what is aborted. */
class Held {
  readonly under: string[] = [];
  private readonly answers = new Map<string, (response: Response) => void>();

  readonly fetch = ((path: string, { signal }: { signal: AbortSignal }) => {
    this.under.push(path);
    return new Promise<Response>((resolve, reject) => {
      signal.addEventListener('abort', () => {
        this.gone(path);
        reject(new DOMException('aborted', 'AbortError'));
      });
      this.answers.set(path, resolve);
    });
  }) as unknown as typeof fetch;

  /** Answers with a body that comes later; returns what ends it. */
  begin(path: string): () => void {
    let end: () => void = () => undefined;
    const body = new ReadableStream({
      start(to) {
        end = () => {
          to.enqueue(new TextEncoder().encode('{}'));
          to.close();
        };
      },
    });
    this.answers.get(path)?.(new Response(body));
    return () => {
      this.gone(path);
      end();
    };
  }

  private gone(path: string): void {
    this.under.splice(this.under.indexOf(path), 1);
  }
}

/** The test ends before its server answers. */
const ask = (asked: Promise<unknown>): void => void asked.catch(() => undefined);
const settled = (): Promise<void> => new Promise((resolve) => setTimeout(resolve, 5));

describe('a server that holds its answers back', () => {
  it('is asked three things at once, one of those that take long, and what restrains at any time', async () => {
    const held = new Held();
    const api = new Api('secret', held.fetch);
    for (const id of ['a', 'b', 'c']) ask(api.telemetryFile(id));
    for (const id of ['a', 'b', 'c', 'd']) ask(api.trace(id));
    await settled();
    const [long, ...short] = ['/v1/audit/telemetry/a/mcap?part=1', '/v1/invocations/a/trace', '/v1/invocations/b/trace'];
    expect(new Set(held.under)).toEqual(new Set([long, ...short]));
    ask(api.estop('workcell-1'));
    expect(held.under.at(-1)).toBe('/v1/cells/workcell-1/estop');
    ask(api.loosen('a', 'resume', 7));
    ask(api.resolve('b', { decision: 'approve', digest: 'sha256:b' }));
    ask(api.restrain('a', 'pause'));
    ask(api.release('a', 'end'));
    ask(api.resolve('b', { decision: 'deny', digest: 'sha256:b', code: 'unsafe' }));
    await settled();
    expect(held.under.slice(-2)).toEqual(['/v1/invocations/a/pause', '/v1/invocations/a/release']);
    held.begin('/v1/invocations/a/pause')();
    await settled();
    expect(held.under.at(-1)).toBe('/v1/escalations/b/resolve');
  });

  it('is asked for the next one once the answer is read to its end, not when it begins', async () => {
    const held = new Held();
    const api = new Api('secret', held.fetch);
    const first = api.telemetryFile('a');
    ask(api.telemetryFile('b'));
    await settled();
    const end = held.begin('/v1/audit/telemetry/a/mcap?part=1');
    await settled();
    expect(held.under).toEqual(['/v1/audit/telemetry/a/mcap?part=1']);
    end();
    expect(await (await first).text()).toBe('{}');
    await settled();
    expect(held.under).toEqual(['/v1/audit/telemetry/b/mcap?part=1']);
  });

  it('is not asked what nobody wants to know any more, nor kept waiting for by it', async () => {
    const held = new Held();
    const api = new Api('secret', held.fetch);
    const [one, other] = [new AbortController(), new AbortController()];
    const asked = [api.comparison('1', one.signal), api.comparison('2', other.signal), api.comparison('3')].map((it) => it.catch((error: unknown) => String(error)));
    await settled();
    expect(held.under).toEqual(['/v1/policies/1/diff']);
    other.abort(); // while it waits for its turn
    one.abort();
    expect(await asked[1]).toContain('The server did not answer.');
    await settled();
    expect(held.under).toEqual(['/v1/policies/3/diff']);
  });

  it('does not say of what was to change something that it did not arrive', async () => {
    const api = new Api('secret', () => Promise.reject(new TypeError('cut')));
    for (const question of [api.cells(), api.check({ capability: 'a', params: {} })]) await expect(question).rejects.toThrow('The server did not answer.');
    for (const call of [api.restrain('a', 'pause'), api.setProfile('a', 'b', 'c')]) await expect(call).rejects.toThrow(UNTOLD);
  });

  it('is told by its own clock until when an answer is waited for, where it was heard', async () => {
    const said: (string | null)[] = [];
    let beat = 0;
    const fetcher: typeof fetch = (_, how) => {
      said.push(new Headers(how?.headers).get('Reins-Patience'));
      return Promise.resolve(new Response('{}'));
    };
    const api = new Api('secret', fetcher, () => ({ beat, since_ms: 150.4 }));
    await api.loosen('inv_1', 'resume', 7);
    beat = 42;
    await api.loosen('inv_1', 'resume', 7);
    await api.activate('sha256:00', 'because', null); // which may take longer than beats are kept
    expect(said).toEqual([null, '42 10150', null]);
  });

  it('says of which refusal a hand-back is said', async () => {
    const said: unknown[] = [];
    const api = new Api('secret', (_, how) => {
      said.push(JSON.parse(how?.body as string));
      return Promise.resolve(new Response('{}'));
    });
    await api.release('inv_1', 'resume', { lease: 'lease_1', after: 7, digest: 'sha256:00' });
    await api.release('inv_1', 'end', { lease: 'lease_1', after: undefined });
    expect(said).toEqual([{ then: 'resume', lease: 'lease_1', after: 7, digest: 'sha256:00' }, { then: 'end', lease: 'lease_1' }]);
  });

  it('says why policy refused something', async () => {
    const problem = { title: '', status: 409, code: 'resume_refused', detail: 'people are asked about this', reasons: [{ rule: 'r', code: 'c', message: 'a person is near', remedy: '' }] };
    const api = new Api('secret', () => Promise.resolve(new Response(JSON.stringify(problem), { status: 409 })));
    const said = await api.release('inv_1', 'resume').catch(refusedWords);
    expect(said).toBe('People are asked about this. A person is near.');
    expect([refusedWords(new TypeError('cut')), refusedWords('gone')]).toEqual(['cut', 'gone']);
  });
});
