// What servants and the machine did since this page is open, for plots: of each the last quarter of an hour; and what the daemon has
// recorded of the last hour and day.
import { asked } from './api';
import type { Link, LocalPeriod, Machine, MachineHistory, Served, ServantHistory } from './types';

const KEPT = 900;

/** Values at times, oldest first. Missing ones are null. */
export class Series<K extends string> {
  /** Seconds since 1970. */
  readonly times: number[] = [];
  readonly values: Record<K, (number | null)[]>;

  /** `kept`: so many times. */
  constructor(
    readonly names: readonly K[],
    readonly kept = KEPT,
  ) {
    this.values = Object.fromEntries(names.map((name) => [name, []])) as unknown as Record<K, (number | null)[]>;
  }

  add(time: number, values: Record<K, number | null | undefined>): void {
    this.times.push(time / 1000);
    for (const name in this.values) this.values[name].push(values[name] ?? null);
    if (this.times.length > this.kept) {
      this.times.shift();
      for (const name in this.values) this.values[name].shift();
    }
  }

  /** What is known last. */
  last(): Record<K, number | null> {
    return Object.fromEntries(this.names.map((name) => [name, this.values[name].at(-1) ?? null])) as Record<K, number | null>;
  }
}

const PHASES = ['serialise', 'up', 'queue', 'compute', 'down'] as const;
const SERVANT = ['cores', 'throttled', 'memory', 'p50', 'p95', 'desire', 'max', 'satisfaction', 'dropped', ...PHASES] as const;
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

/** Where the time of the slowest link's requests goes: medians. */
function phases(served: Served): Partial<Record<(typeof PHASES)[number], number>> {
  const total = (link: Link) => link.phases.find((part) => part.name === 'total')?.p50 ?? -1;
  const slowest = [...served.links].sort((one, other) => total(other) - total(one))[0];
  return Object.fromEntries((slowest?.phases ?? []).filter((part) => part.name !== 'total').map((part) => [part.name, part.p50]));
}

/** Of when a plot is: since the page is open, or what the daemon has recorded. */
export type Of = 'page' | 'hour' | 'day';
const STEPS = { hour: 10, day: 60 };
const SECONDS = { hour: 3600, day: 86400 };

/** What is recorded, as a series that goes on: null where the daemon has not looked. */
function recorded<K extends string>(names: readonly K[], of: 'hour' | 'day', times: number[], values: (name: K) => (number | null)[]): Series<K> {
  const step = STEPS[of];
  const series = new Series(names, SECONDS[of] / step + 60);
  const lists = Object.fromEntries(names.map((name) => [name, values(name)])) as Record<K, (number | null)[]>;
  times.forEach((time, index) => {
    const before = times[index - 1];
    const none = Object.fromEntries(names.map((name) => [name, null])) as Record<K, null>;
    if (before !== undefined && time - before > step * 2500) series.add(before + 1000, none);
    series.add(time, Object.fromEntries(names.map((name) => [name, lists[name][index]])) as Record<K, number | null>);
  });
  return series;
}

/** What a servant did, which may have ended, and when its robot was served by the local original; `found` is none where nothing is recorded of it. */
export async function servantPast(id: string, of: 'hour' | 'day'): Promise<{ found?: ServantHistory; series: ServantSeries; local: LocalPeriod[] }> {
  const [found] = await asked<ServantHistory[]>(`/history/servants?servant=${encodeURIComponent(id)}&step=${STEPS[of]}`);
  const figures = found?.figures;
  const series = recorded(SERVANT, of, figures?.time ?? [], (name) => {
    const list = figures?.[name] ?? [];
    return name === 'throttled' ? list.map((share) => share && share * 100) : list;
  });
  return { ...(found && { found }), series, local: found?.local ?? [] };
}

/** Servants that were there in the last day, the newest first; `now` is the daemon's clock. No figure is of a time that long ago: none is sent. */
export function servantsPast(now: number): Promise<ServantHistory[]> {
  const from = Math.round(now) - SECONDS.day * 1000;
  return asked<ServantHistory[]>(`/history/servants?from=${from}&to=${from}`);
}

export async function machinePast(of: 'hour' | 'day'): Promise<MachineSeries> {
  const { figures } = await asked<MachineHistory>(`/history/machine?step=${STEPS[of]}`);
  const named = { cores: 'cores', promised: 'promised', memory: 'memory', cpu: 'cpu_waits', stalled: 'memory_waits', io: 'io_waits' } as const;
  return recorded(MACHINE, of, figures.time, (name) => figures[named[name]]);
}

/** Adds what is so now to what was recorded, once its step is over. */
export function goesOn<K extends string>(past: Series<K>, of: 'hour' | 'day', now: Series<K>): void {
  const time = now.times.at(-1);
  if (time === undefined || time < (past.times.at(-1) ?? 0) + STEPS[of]) return;
  past.add(time * 1000, now.last());
}

export const machine: MachineSeries = new Series(MACHINE);
export const servants = new Map<string, ServantSeries>();

const TOPICS = ['first', 'second', 'third', 'fourth', 'fifth'] as const;

/** Messages dropped by topic, of the first five topics of a servant that lost some. */
export interface TopicDrops {
  /** Of each series in its order. */
  topics: string[];
  series: Series<(typeof TOPICS)[number]>;
}
export const dropsByTopic = new Map<string, TopicDrops>();
/** The name of a topic's series. */
export const dropKey = (place: number) => TOPICS[place]!;

function rememberDrops(time: number, id: string, served: Served): void {
  const now = served.servant.drops ?? [];
  let known = dropsByTopic.get(id);
  if (!known && !now.length) return;
  if (!known) dropsByTopic.set(id, (known = { topics: [], series: new Series(TOPICS) }));
  for (const { topic } of now) {
    if (known.topics.length < TOPICS.length && !known.topics.includes(topic)) known.topics.push(topic);
  }
  const counted = known.topics.map((topic, place) => [TOPICS[place], now.find((one) => one.topic === topic)?.count]);
  known.series.add(time, Object.fromEntries(counted) as Record<(typeof TOPICS)[number], number | undefined>);
}

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
  for (const id of dropsByTopic.keys()) if (!now.has(id)) dropsByTopic.delete(id);
  for (const [id, served] of now) {
    rememberDrops(time, id, served);
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
      ...phases(served),
    } as Record<(typeof SERVANT)[number], number | undefined>);
  }
}
