// Numbers within messages over time, each found by the path of its field.

/** Seconds that are kept, and values of each field at the most; the newest win. */
export const SPAN = 60;
const KEPT = 1500;
/** Fields that are drawn together: there are as many colours. */
export const MOST_FIELDS = 5;

/** A number that is shown in a tree can be chosen for a plot. */
export interface Plotting { paths: string[]; toggle: (path: string) => void }

/** The path of a part: `pose.position.x`, `ranges[3]`. */
export const pathOf = (whole: string, key: string, isList: boolean) => (isList ? `${whole}[${key}]` : whole ? `${whole}.${key}` : key);

/** The number at a path, 0 or 1 for a boolean; null where there is none. */
export function numberAt(message: unknown, path: string): number | null {
  let at = message;
  for (const part of path.split(/[.[\]]+/).filter(Boolean)) {
    if (at === null || typeof at !== 'object') return null;
    at = (at as Record<string, unknown>)[part];
  }
  if (typeof at === 'boolean' || typeof at === 'bigint') return Number(at);
  return typeof at === 'number' && Number.isFinite(at) ? at : null;
}

/** What the chosen fields of one topic were. */
export class FieldHistory {
  /** When messages came, in seconds since 1970. */
  readonly times: number[] = [];
  readonly #values = new Map<string, (number | null)[]>();

  /** Keeps the values of fields that were chosen before; the others have none yet. */
  choose(paths: string[]): void {
    for (const path of this.#values.keys()) if (!paths.includes(path)) this.#values.delete(path);
    for (const path of paths) if (!this.#values.has(path)) this.#values.set(path, this.times.map(() => null));
  }

  values(path: string): (number | null)[] {
    return this.#values.get(path) ?? [];
  }

  add(time: number, message: unknown): void {
    this.times.push(time);
    for (const [path, values] of this.#values) values.push(numberAt(message, path));
    while (this.times.length > KEPT || this.times[0]! < time - SPAN) {
      this.times.shift();
      for (const values of this.#values.values()) values.shift();
    }
  }
}
