// What servants and the machine did since this page is open, for plots. Of each the last quarter of an hour is kept.
import type { Machine, Served } from './types';

export const KEPT = 900;

/** Values at times, oldest first. Missing ones are null. */
export class Series<K extends string> {
  /** Seconds since 1970. */
  readonly times: number[] = [];
  readonly values: Record<K, (number | null)[]>;

  constructor(names: readonly K[]) {
    this.values = Object.fromEntries(names.map((name) => [name, []])) as unknown as Record<K, (number | null)[]>;
  }

  add(time: number, values: Record<K, number | null | undefined>): void {
    this.times.push(time / 1000);
    for (const name in this.values) this.values[name].push(values[name] ?? null);
    if (this.times.length > KEPT) {
      this.times.shift();
      for (const name in this.values) this.values[name].shift();
    }
  }
}

const SERVANT = ['cores', 'throttled', 'memory', 'p50', 'p95', 'desire', 'max', 'satisfaction', 'dropped'] as const;
const MACHINE = ['cores', 'promised', 'memory', 'cpu', 'stalled', 'io'] as const;

export type ServantSeries = Series<(typeof SERVANT)[number]>;
export type MachineSeries = Series<(typeof MACHINE)[number]>;

/** Milliseconds of `100ms`, `1.5s`, as robots state them. */
function span(written: string | undefined): number | undefined {
  const [, digits, unit] = /^([\d.]+)\s*(us|ms|s)$/.exec(written ?? '') ?? [];
  return digits === undefined ? undefined : Number(digits) * { us: 0.001, ms: 1, s: 1000 }[unit as 'us' | 'ms' | 's'];
}

/** The strictest of what its robot's nodes are promised, or what it has stated. */
export function promise(served: Served): { desire?: number; max?: number; satisfaction?: number } {
  const least = (all: (number | undefined)[]) => {
    const known = all.filter((value) => value != null);
    return known.length ? Math.min(...known) : undefined;
  };
  const stated = Object.values(served.servant.terms?.stated ?? {});
  const { links } = served;
  return {
    desire: least([...links.map((link) => link.desire), ...stated.map((one) => span(one.sla?.rrt))]),
    max: least([...links.map((link) => link.max), ...stated.map((one) => span(one.sla?.max_rrt))]),
    satisfaction: least(links.map((link) => link.satisfaction)),
  };
}

export const machine: MachineSeries = new Series(MACHINE);
export const servants = new Map<string, ServantSeries>();

export function rememberMachine(time: number, now: Machine): void {
  machine.add(time, {
    cores: now.cores,
    promised: now.capacity.cpus_reserved,
    memory: now.usage.memory,
    cpu: now.usage.pressure?.cpu,
    stalled: now.usage.pressure?.memory,
    io: now.usage.pressure?.io,
  });
}

export function rememberServants(time: number, now: Map<string, Served>): void {
  for (const id of servants.keys()) if (!now.has(id)) servants.delete(id);
  for (const [id, served] of now) {
    let series = servants.get(id);
    if (!series) servants.set(id, (series = new Series(SERVANT)));
    const { usage, response, dropped } = served.servant;
    series.add(time, {
      cores: usage && served.cores,
      throttled: usage && served.throttled * 100,
      memory: usage?.memory,
      p50: response?.p50_ms,
      p95: response?.p95_ms,
      dropped,
      ...promise(served),
    } as Record<(typeof SERVANT)[number], number | undefined>);
  }
}
