import { describe, expect, it } from 'vitest';
import { candidateOf, read } from '../src/lib/policy/candidate';

const sized = (name: string, size: number): File => Object.defineProperty(new File([''], name), 'size', { value: size });

describe('what is picked', () => {
  it('is not read where it is larger than any policy, as one file, as several or in an archive', async () => {
    const half = new File(['x'.repeat(3_000_000)], 'half.yaml');
    for (const picked of [[sized('vast.yaml', 100_000_000)], [sized('vast.zip', 100_000_000)], [half, half]]) {
      await expect(read(picked)).rejects.toThrow('larger than any policy');
    }
    expect(await read([half, sized('vast.png', 100_000_000)])).toHaveLength(2);
  });

  it('is refused where two of it would be one file: neither is brought in the other’s place', () => {
    const live = { 'profiles/a.yaml': 'profile: a' };
    for (const path of ['profiles/a.yaml', 'a.yaml', './a.yaml']) {
      const twice = [{ path: 'a.yaml', text: 'profile: a\nmax: 40' }, { path, text: 'profile: a\nmax: 90' }];
      expect(() => candidateOf(twice, live)).toThrow('would both be `profiles/a.yaml`');
    }
  });
});
