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
