// `.cloudroidignore` files, in the syntax of .gitignore, as `cloudroidctl push` obeys them.
import type { Entry } from './tar';

export const IGNORE_FILE = '.cloudroidignore';

/** A part of a pattern. */
type Token =
  | { kind: 'character'; character: string }
  /** `?`: one character of a name. */
  | { kind: 'one' }
  /** `*`: any part of a name. */
  | { kind: 'run' }
  /** `[a-z]`: one character of a name, in (or, negated, outside of) these ranges. */
  | { kind: 'class'; negated: boolean; ranges: [string, string][] }
  /** A `**` before a slash: any number of whole directories. */
  | { kind: 'directories' }
  /** A `**` at the end: everything below. */
  | { kind: 'rest' };

interface Rule {
  pattern: Token[];
  /** The line begins with `!`: matching files are sent. */
  negated: boolean;
  /** The line ends with `/`: only directories match. */
  directories: boolean;
}

/** The members of a class, as written between its brackets. */
function ranges(members: string[]): [string, string][] {
  const found: [string, string][] = [];
  for (let at = 0; at < members.length; ) {
    const isRange = members[at + 1] === '-' && at + 2 < members.length;
    found.push([members[at]!, members[isRange ? at + 2 : at]!]);
    at += isRange ? 3 : 1;
  }
  return found;
}

/** The parts of a pattern, without its `!` and last `/`. */
function tokens(line: string): Token[] {
  const found: Token[] = line.includes('/') ? [] : [{ kind: 'directories' }];
  let rest = line.replace(/^\//, '');
  let beginsName = true;
  while (rest) {
    const begins = beginsName;
    beginsName = false;
    const group = /^\[([!^]?)(\]?[^\]]*)\]/.exec(rest);
    if (begins && rest === '**') {
      found.push({ kind: 'rest' });
      rest = '';
    } else if (begins && rest.startsWith('**/')) {
      found.push({ kind: 'directories' });
      rest = rest.slice(3);
      beginsName = true;
    } else if (rest.startsWith('[')) {
      if (!group?.[2]) throw new Error(`${IGNORE_FILE}: ${rest} has no ]`);
      found.push({ kind: 'class', negated: !!group[1], ranges: ranges([...group[2]]) });
      rest = rest.slice(group[0].length);
    } else {
      const escaped = rest.startsWith('\\') && rest.length > 1;
      const character = String.fromCodePoint(rest.codePointAt(escaped ? 1 : 0)!);
      const kind = escaped ? 'character' : character === '*' ? 'run' : character === '?' ? 'one' : 'character';
      found.push(kind === 'character' ? { kind, character } : { kind });
      beginsName = character === '/';
      rest = rest.slice((escaped ? 1 : 0) + character.length);
    }
  }
  return found;
}

/** Whether a token may go on matching after a character, and whether the next one begins after it. */
function takes(token: Token, character: string): [boolean, boolean] {
  switch (token.kind) {
    case 'character':
      return [false, token.character === character];
    case 'one':
      return [false, character !== '/'];
    case 'run':
      return [character !== '/', false];
    case 'class': {
      const isWithin = token.ranges.some(([first, last]) => first <= character && character <= last);
      return [false, character !== '/' && isWithin !== token.negated];
    }
    case 'directories':
      return [true, false];
    case 'rest':
      return [true, true];
  }
}

/**
 * Whether a path matches. All ways to match are followed at once, so the time is bounded by the product of the lengths, whatever
 * the pattern is.
 */
function matches(pattern: Token[], path: string): boolean {
  /** Goes on after tokens that may match nothing. */
  const skipEmpty = (reached: boolean[], beginsName: boolean) =>
    pattern.forEach(({ kind }, at) => {
      if (reached[at] && (kind === 'run' || (kind === 'directories' && beginsName))) reached[at + 1] = true;
    });
  let reached: boolean[] = [true];
  skipEmpty(reached, true);
  for (const character of path) {
    const next: boolean[] = [];
    pattern.forEach((token, at) => {
      if (!reached[at]) return;
      const [stays, goesOn] = takes(token, character);
      if (stays) next[at] = true;
      if (goesOn) next[at + 1] = true;
    });
    skipEmpty(next, character === '/');
    reached = next;
  }
  return !!reached[pattern.length];
}

function rules(text: string): Rule[] {
  return text.split('\n').flatMap((written) => {
    let line = written.replace(/\r$/, '').replace(/(?<!\\) +$/, '');
    if (!line || line.startsWith('#')) return [];
    const negated = line.startsWith('!');
    if (negated) line = line.slice(1);
    const directories = line.endsWith('/');
    if (directories) line = line.slice(0, -1);
    return line.replace(/^\//, '') ? [{ pattern: tokens(line), negated, directories }] : [];
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
      const found = rules.findLast((rule) => (isDirectory || !rule.directories) && matches(rule.pattern, below));
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
