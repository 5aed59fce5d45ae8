// Parameters of ROS as JSON text, and settings of dynamic_reconfigure.

/** What a value is, in words; or what is wrong with its text. */
export function kind(text: string): { kind?: string; wrong?: string } {
  let value: unknown;
  try {
    value = JSON.parse(text);
  } catch (error) {
    return { wrong: `not valid JSON (strings need "quotes"): ${(error as Error).message}` };
  }
  if (value === null) return { wrong: 'a parameter cannot be null; remove it instead' };
  if (Array.isArray(value)) return { kind: 'a list' };
  switch (typeof value) {
    case 'boolean': return { kind: 'true or false' };
    case 'string': return { kind: 'a string' };
    case 'number': return { kind: /[.eE]/.test(text) ? 'a floating-point number' : 'an integer' };
    default: return { kind: 'a dictionary' };
  }
}

/** A literal of Python (numbers, texts, lists, tuples, dictionaries): edit methods of dynamic_reconfigure are written so. Throws an Error. */
export function literal(text: string): unknown {
  let at = 0;
  const skip = () => { while (/\s/.test(text[at] ?? '')) at += 1; };
  const fail = (): never => { throw new Error(`no literal at character ${at} of ${text}`); };
  const list = (close: string): unknown[] => {
    const found: unknown[] = [];
    at += 1;
    for (skip(); text[at] !== close; skip()) {
      found.push(value());
      skip();
      if (text[at] === ',') at += 1;
      else if (text[at] !== close) fail();
    }
    at += 1;
    return found;
  };
  const quoted = (): string => {
    const quote = text[at];
    let found = '';
    for (at += 1; text[at] !== quote; at += 1) {
      if (text[at] === undefined) fail();
      if (text[at] === '\\') at += 1;
      found += text[at];
    }
    at += 1;
    return found;
  };
  function value(): unknown {
    skip();
    const next = text[at];
    if (next === "'" || next === '"') return quoted();
    if (next === '[') return list(']');
    if (next === '(') return list(')');
    if (next === '{') {
      const members: Record<string, unknown> = {};
      at += 1;
      for (skip(); text[at] !== '}'; skip()) {
        const key = String(value());
        skip();
        if (text[at] !== ':') fail();
        at += 1;
        members[key] = value();
        skip();
        if (text[at] === ',') at += 1;
        else if (text[at] !== '}') fail();
      }
      at += 1;
      return members;
    }
    const word = /^[-+\w.]+/.exec(text.slice(at))?.[0] ?? fail();
    at += word.length;
    if (word === 'True' || word === 'False') return word === 'True';
    if (word === 'None') return null;
    // As unicode texts of Python 2: u'...'.
    if (word === 'u' && (text[at] === "'" || text[at] === '"')) return quoted();
    return Number.isNaN(Number(word)) ? fail() : Number(word);
  }
  return value();
}

// dynamic_reconfigure/Config and ConfigDescription.
interface Named<T> { name: string; value: T }
export interface Config { bools: Named<boolean>[]; ints: Named<number>[]; strs: Named<string>[]; doubles: Named<number>[]; groups: unknown[] }
export interface Description {
  groups: { name: string; parameters: { name: string; type: string; description: string; edit_method: string }[] }[];
  max: Config;
  min: Config;
  dflt: Config;
}

export type Value = boolean | number | string;
export interface Choice { name: string; value: Value; description: string }
export interface Setting { name: string; group: string; type: 'bool' | 'int' | 'double' | 'str'; description: string; least?: number; most?: number; choices: Choice[] }

const LISTS = { bool: 'bools', int: 'ints', double: 'doubles', str: 'strs' } as const;

/** All values of a configuration, by name. */
export function values(config: Config): Record<string, Value> {
  return Object.fromEntries(Object.values(LISTS).flatMap((list) => config[list].map(({ name, value }) => [name, value])));
}

/** A configuration of one value. */
export function single(setting: Setting, value: Value): Config {
  const config: Config = { bools: [], ints: [], strs: [], doubles: [], groups: [] };
  (config[LISTS[setting.type]] as Named<Value>[]).push({ name: setting.name, value });
  return config;
}

function choices(method: string): Choice[] {
  if (!method.trim()) return [];
  try {
    const { enum: found } = literal(method) as { enum?: { name: unknown; value: Value; description?: unknown }[] };
    return (found ?? []).map(({ name, value, description }) => ({ name: String(name), value, description: String(description ?? '') }));
  } catch {
    return [];
  }
}

/** What can be set, as it is described. */
export function settings({ groups, min, max }: Description): Setting[] {
  const [least, most] = [values(min), values(max)];
  return groups.flatMap(({ name: group, parameters }) => parameters.flatMap(({ name, type, description, edit_method }) => {
    if (!(type in LISTS)) return [];
    const bounds = type === 'int' || type === 'double' ? { least: Number(least[name]), most: Number(most[name]) } : {};
    return [{ name, group, type: type as Setting['type'], description, ...bounds, choices: choices(edit_method) }];
  }));
}
