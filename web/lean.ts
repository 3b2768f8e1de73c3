import type { Plugin } from 'vite';

/** What three's animation classes write to their prototypes as they are read: only that keeps them in a bundle that animates nothing. */
const WRITTEN = /^(?:\w*KeyframeTrack|PropertyBinding)\.[\w.]+ = [^;]*;$/gm;

/** Leaves three's keyframe animation out of the bundle, 5 kB of its 125; whoever imports it has to take this away. */
export function withoutAnimation(): Plugin {
  return {
    name: 'reins-without-animation',
    apply: 'build',
    transform: {
      filter: { id: /three\.core\.js$/ },
      handler(code) {
        const leaner = code.replace(WRITTEN, '');
        if (leaner === code) this.warn('three writes to no prototypes of its animation any more: this plugin does nothing');
        return { code: leaner, map: null };
      },
    },
  };
}

/** Materials that the scene is drawn with, and the shader of each. */
const SHADERS: Readonly<Record<string, string>> = {
  LineBasicMaterial: 'meshbasic',
  LineDashedMaterial: 'linedashed',
  MeshBasicMaterial: 'meshbasic',
  MeshLambertMaterial: 'meshlambert',
};
const NAMED = /^\t(\w+): ([\w$]+),?$/gm;
const TEXT = /^(?:const|var) ([\w$]+) = ("(?:[^"\\]|\\.)*");$/gm;
const INCLUDED = /#include <(\w+)>/g;
/** What the renderer puts in by itself. */
const ASKED = /ShaderChunk\[ '(\w+)' \]/g;
const MATERIAL = /\b\w+Material\b/g;
/** What prepares surroundings for surfaces to mirror. */
const MIRRORED = /new PMREMGenerator\( renderer \)/g;
/** What would have a scene mirror them. */
const MIRRORS = /\b(?:environment|envMap)\b/;
/** What lets a scene be shown in a headset. */
const WORN = /new WebXRManager\( _this, _gl \)/g;
/** In its place: nobody wears one, and all that a renderer asks of that. */
const UNWORN = 'Object.assign(new EventDispatcher(), { enabled: false, isPresenting: false, getEnvironmentBlendMode: () => null, setAnimationLoop: () => {}, dispose: () => {} })';
/** A table of numbers that only physically based materials look up. */
const TABLE = /^const DATA = new Uint16Array\( \[[^\]]*\] \);$/m;

/** Leaves out of the bundle the shaders of materials that nothing here is drawn with, 11 kB of three's 122, what lets one mirror its surroundings, 3 kB, and what shows it in a headset, 3 kB; a scene that asks for either does not build. */
export function withoutOtherShaders(): Plugin {
  return {
    name: 'reins-without-other-shaders',
    apply: 'build',
    transform: {
      filter: { id: /three\.module\.js$|\/src\/lib\/scene\/.*\.ts$/ },
      handler(code, id) {
        if (!id.endsWith('three.module.js')) {
          const other = [...code.matchAll(MATERIAL)].find(([name]) => !(name in SHADERS));
          if (other) this.error(`the shader of ${other[0]} is left out of the bundle; valid: ${Object.keys(SHADERS).join(', ')}, or name it in lean.ts`);
          if (MIRRORS.test(code)) this.error('what lets a surface mirror its surroundings is left out of the bundle by lean.ts; valid: a scene without `environment` and `envMap`');
          return null;
        }
        return { code: lean(code), map: null };
      },
    },
  };
}

/** three's module with nothing in the table and in the texts that neither the renderer nor a shader in use includes, be it by way of others. Throws where it is written otherwise than that. */
function lean(code: string): string {
  const start = code.indexOf('const ShaderChunk = {');
  const named = new Map([...code.slice(start, code.indexOf('};', start)).matchAll(NAMED)].map(([, name = '', held = '']) => [name, held]));
  const texts = new Map([...code.matchAll(TEXT)].map(([, held = '', text = '']) => [held, text]));
  const kept = new Set<string>();
  const keep = (name: string): void => {
    const held = named.get(name) ?? '';
    const text = texts.get(held);
    if (text === undefined) throw new Error(`three's shaders have no \`${name}\` where lean.ts looks for it`);
    if (kept.has(held)) return;
    kept.add(held);
    for (const [, included = ''] of text.matchAll(INCLUDED)) keep(included);
  };
  const rest = code.replace(TEXT, '');
  for (const [, name = ''] of [...rest.matchAll(ASKED), ...rest.matchAll(INCLUDED)]) keep(name);
  for (const shader of Object.values(SHADERS)) for (const part of ['vert', 'frag']) keep(`${shader}_${part}`);
  if (!TABLE.test(code)) throw new Error('three has no table `DATA` where lean.ts looks for it');
  if (code.search(MIRRORED) < 0) throw new Error('three has no `PMREMGenerator` where lean.ts looks for it');
  if (code.search(WORN) < 0) throw new Error('three has no `WebXRManager` where lean.ts looks for it');
  const chunks = new Set(named.values());
  return code.replace(TEXT, (whole, held: string) => (!chunks.has(held) || kept.has(held) ? whole : `const ${held} = "";`)).replace(TABLE, 'const DATA = new Uint16Array(0);').replace(MIRRORED, 'null').replace(WORN, UNWORN);
}
