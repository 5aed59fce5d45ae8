// Frames as /tf and /tf_static tell of them: a tree, or what keeps them from being one.

export interface Transform {
  header: { frame_id: string };
  child_frame_id: string;
  transform: { translation: { x: number; y: number; z: number }; rotation: { x: number; y: number; z: number; w: number } };
}

export interface Frame {
  name: string;
  parent: string;
  fixed: boolean;
  /** When it was told of, in milliseconds; the last ones. */
  told: number[];
  latest: Transform['transform'];
  /** Other parents that it was given within the last ones. */
  others: string[];
}

/** Times that are kept for a rate. */
const KEPT = 50;
/** A parent that was not named for so long is not named any more. */
const OVER = 5_000;

// tf of old writes names with a slash before them.
const bare = (name: string) => name.replace(/^\/+/, '');

export class Frames {
  readonly frames = new Map<string, Frame>();
  readonly #named = new Map<string, Map<string, number>>();

  hear(transforms: Transform[], fixed: boolean, now: number): void {
    for (const { header, child_frame_id, transform } of transforms) {
      const [name, parent] = [bare(child_frame_id), bare(header.frame_id)];
      const named = this.#named.get(name) ?? new Map<string, number>();
      this.#named.set(name, named.set(parent, now));
      for (const [other, at] of named) if (now - at > OVER && !fixed) named.delete(other);
      const told = [...(this.frames.get(name)?.told ?? []), now].slice(-KEPT);
      this.frames.set(name, { name, parent, fixed, told, latest: transform, others: [...named.keys()].filter((other) => other !== parent) });
    }
  }

  /** Frames that are nobody's child. */
  roots(): string[] {
    const parents = new Set([...this.frames.values()].map((frame) => frame.parent));
    return [...parents].filter((name) => !this.frames.has(name)).sort();
  }

  children(of: string): Frame[] {
    return [...this.frames.values()].filter((frame) => frame.parent === of).sort((a, b) => (a.name < b.name ? -1 : 1));
  }

  /** What keeps them from being one tree, in words. */
  wrong(): string[] {
    const said: string[] = [];
    const seen = new Set<string>();
    for (const start of [...this.frames.keys()].sort()) {
      const way: string[] = [];
      let at: string | undefined = start;
      while (at !== undefined && !seen.has(at) && !way.includes(at)) {
        way.push(at);
        at = this.frames.get(at)?.parent;
      }
      if (at !== undefined && way.includes(at)) {
        const loop = way.slice(way.indexOf(at)).reverse();
        said.push(`${[...loop, loop[0]].join(' → ')} is a loop: these frames have no position`);
      }
      for (const name of way) seen.add(name);
    }
    const roots = this.roots();
    if (roots.length > 1) said.push(`${roots.join(', ')}: no transform connects these frames`);
    for (const { name, parent, others } of [...this.frames.values()].sort((a, b) => (a.name < b.name ? -1 : 1))) {
      if (others.length) said.push(`${name} has the parents ${[parent, ...others].sort().join(' and ')}: its position jumps between them`);
    }
    return said;
  }
}

/** How often it is told of, a second. */
export function rate({ told }: Frame): number {
  const [first, last] = [told[0] ?? 0, told[told.length - 1] ?? 0];
  return last > first ? ((told.length - 1) * 1000) / (last - first) : 0;
}

const DEGREES = 180 / Math.PI;

/** Roll, pitch and yaw in degrees (REP 103). */
export function angles({ x, y, z, w }: Transform['transform']['rotation']): [number, number, number] {
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) * DEGREES,
    Math.asin(Math.min(1, Math.max(-1, 2 * (w * y - z * x)))) * DEGREES,
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) * DEGREES,
  ];
}
