// What Vite writes is built into the daemon as it is: strict about what the page's content security policy allows, and within
// the size that the page may have.
import { readdirSync, readFileSync, statSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { brotliCompressSync, constants, gzipSync } from 'node:zlib';
import { svelte } from '@sveltejs/vite-plugin-svelte';
import { defineConfig } from 'vite';

// Bytes of all files, by gzip.
const BUDGET = 200_000;

// Writes each file compressed, too, so that the daemon need not, and refuses to write too much.
function compressed() {
  let directory;
  return {
    name: 'compressed',
    apply: 'build',
    configResolved: (config) => { directory = config.build.outDir; },
    // Not at closeBundle, which is called after a failed build, too.
    writeBundle() {
      let sum = 0;
      for (const name of readdirSync(directory, { recursive: true })) {
        const path = join(directory, name);
        if (!statSync(path).isFile()) continue;
        const bytes = readFileSync(path);
        const gzip = gzipSync(bytes, { level: 9 });
        sum += gzip.length;
        writeFileSync(`${path}.gz`, gzip);
        writeFileSync(`${path}.br`, brotliCompressSync(bytes, { params: { [constants.BROTLI_PARAM_SIZE_HINT]: bytes.length } }));
      }
      console.log(`the page has ${sum} bytes by gzip, of ${BUDGET}`);
      if (sum > BUDGET) throw new Error(`the page has ${sum} bytes by gzip and may have ${BUDGET}; see what grew with: npx vite build --mode development`);
    },
  };
}

// The licences of what others wrote and the page holds, beside it: most ask for that.
function licences() {
  return {
    name: 'licences',
    apply: 'build',
    generateBundle(_, bundle) {
      const modules = Object.values(bundle).flatMap((chunk) => Object.keys(chunk.modules ?? {}));
      const packages = new Set(modules.map((path) => /^(.*\/node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(path)?.[1]).filter(Boolean));
      const texts = [...packages].sort().map((directory) => {
        const { name, version, license } = JSON.parse(readFileSync(join(directory, 'package.json'), 'utf8'));
        const file = readdirSync(directory).find((one) => /^licen[cs]e/i.test(one));
        return `${name} ${version} (${license ?? 'as follows'})\n\n${file ? readFileSync(join(directory, file), 'utf8').trim() : 'Its package holds no text of it.'}\n`;
      });
      this.emitFile({ type: 'asset', fileName: 'assets/licences.txt', source: texts.join(`\n${'-'.repeat(80)}\n\n`) });
    },
  };
}

export default defineConfig({
  plugins: [svelte(), licences(), compressed()],
  // Addresses of assets are the daemon's.
  build: {
    assetsDir: 'assets',
    // Pictures within the style sheet would be data: addresses, which the policy does not allow.
    assetsInlineLimit: 0,
    target: 'es2022',
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1000,
  },
  // `npm run dev` with the API of a daemon that runs: CLOUDROID_SERVER=http://127.0.0.1:9090.
  server: {
    proxy: { '/api': { target: process.env.CLOUDROID_SERVER ?? 'http://127.0.0.1:9090', changeOrigin: true, secure: false, ws: true } },
  },
});
