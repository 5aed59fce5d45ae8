// `.cloudroidignore` files, in the syntax of .gitignore, as `cloudroidctl push` obeys them.
import type { Entry } from './tar';

export const IGNORE_FILE = '.cloudroidignore';

interface Rule {
  pattern: RegExp;
  /** The line begins with `!`: matching files are sent. */
  negated: boolean;
  /** The line ends with `/`: only directories match. */
  directories: boolean;
}

const literal = (text: string) => text.replace(/[\\^$.*+?()[\]{}|/-]/g, '\\$&');

/** The expression for a pattern, without its `!` and last `/`. */
function expression(line: string): RegExp {
  const anchored = line.includes('/');
  let rest = line.replace(/^\//, '');
  let source = anchored ? '' : '(?:.*/)?';
  let beginsName = true;
  while (rest) {
    const begins = beginsName;
    beginsName = false;
    const group = /^\[([!^]?)(\]?[^\]]*)\]/.exec(rest);
    if (begins && rest === '**') {
      source += '.+';
      rest = '';
    } else if (begins && rest.startsWith('**/')) {
      source += '(?:.*/)?';
      rest = rest.slice(3);
      beginsName = true;
    } else if (rest.startsWith('[')) {
      if (!group?.[2]) throw new Error(`${IGNORE_FILE}: ${rest} has no ]`);
      source += `(?!/)[${group[1] ? '^' : ''}${group[2].replace(/[\\\]^[]/g, '\\$&')}]`;
      rest = rest.slice(group[0].length);
    } else {
      const escaped = rest.startsWith('\\') && rest.length > 1;
      const sign = rest.charAt(escaped ? 1 : 0);
      source += !escaped && sign === '*' ? '[^/]*' : !escaped && sign === '?' ? '[^/]' : literal(sign);
      beginsName = sign === '/';
      rest = rest.slice(escaped ? 2 : 1);
    }
  }
  return new RegExp(`^${source}$`, 's');
}

function rules(text: string): Rule[] {
  return text.split('\n').flatMap((written) => {
    let line = written.replace(/\r$/, '').replace(/(?<!\\) +$/, '');
    if (!line || line.startsWith('#')) return [];
    const negated = line.startsWith('!');
    if (negated) line = line.slice(1);
    const directories = line.endsWith('/');
    if (directories) line = line.slice(0, -1);
    return line.replace(/^\//, '') ? [{ pattern: expression(line), negated, directories }] : [];
  });
}

/**
 * The files that are not ignored, without the ignore files themselves. Of several patterns the last one decides, and those of
 * deeper directories come later; below an ignored directory nothing is sent.
 * @throws an Error that names a pattern which cannot be read
 */
export async function unignored(all: Entry[]): Promise<Entry[]> {
  const files = all.filter(({ path }) => path === IGNORE_FILE || path.endsWith(`/${IGNORE_FILE}`));
  const known = await Promise.all(
    files.map(async ({ path, file }) => ({ base: path.slice(0, -IGNORE_FILE.length), rules: rules(await file.text()) })),
  );
  known.sort((a, b) => b.base.length - a.base.length);
  const isIgnored = (path: string, isDirectory: boolean) => {
    for (const { base, rules } of known) {
      if (!path.startsWith(base)) continue;
      const below = path.slice(base.length);
      const found = rules.findLast((rule) => (isDirectory || !rule.directories) && rule.pattern.test(below));
      if (found) return !found.negated;
    }
    return false;
  };
  return all.filter(({ path }) => {
    if (path === IGNORE_FILE || path.endsWith(`/${IGNORE_FILE}`)) return false;
    const segments = path.split('/');
    return !segments.some((_, at) => isIgnored(segments.slice(0, at + 1).join('/'), at < segments.length - 1));
  });
}
