import { fileURLToPath } from 'node:url';
import { svelte } from '@sveltejs/vite-plugin-svelte';
import { defineConfig } from 'vitest/config';
import { compressed } from './compressed.ts';
import { leanFonts } from './fonts.ts';
import { withoutAnimation, withoutOtherShaders } from './lean.ts';

const server = process.env['REINS_SERVER'] ?? 'http://127.0.0.1:8000';

export default defineConfig({
  plugins: [svelte(), withoutAnimation(), withoutOtherShaders(), leanFonts(), compressed()],
  build: {
    outDir: fileURLToPath(new URL('../app/console', import.meta.url)),
    emptyOutDir: true,
    target: 'es2023',
    cssCodeSplit: false, // a page that had to be fetched twice would come without its own
    modulePreload: { polyfill: false },
    assetsInlineLimit: 0, // a data: address would need a wider content security policy
    chunkSizeWarningLimit: 1000,
    rolldownOptions: { checks: { bundlerTimings: false } }, // which of its parts took how long is nothing whoever sets up has to read
  },
  worker: { format: 'es', rolldownOptions: { output: { entryFileNames: 'assets/worker-[hash].js' } } }, // a name that the server sends its own policy with
  server: { proxy: { '/v1': { target: server, ws: true, changeOrigin: true } } },
  test: { include: ['tests/**/*.test.ts'], environment: 'node', isolate: false },
});
