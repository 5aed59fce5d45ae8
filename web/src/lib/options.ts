// What a push may be told, in the command line's words: `cloudroidctl push --help`.
import type { Options } from './push.svelte';

export interface Field {
  key: string;
  label: string;
  /** The command line's flag for the same. */
  flag: string;
  example?: string;
  /** So many lines of text, one entry each. */
  lines?: number;
}

/** What is told of every push. */
export const PARAMETERS: Field = { key: 'params', label: 'Parameters, KEY=VALUE, one a line; global ones begin with /', flag: '--param', example: 'debug_view=false', lines: 2 };
export const NAME: Field = { key: 'name', label: "Name of the service; the package's by default", flag: '--name' };
export const NODES: Field = { key: 'nodes', label: 'Programs, each with its arguments, one a line', flag: '--node', example: 'people_detect', lines: 2 };
export const LAUNCH: Field = { key: 'launch', label: 'Launch file, as roslaunch finds it in the package', flag: '--launch', example: 'my.launch' };
export const ARGUMENTS: Field = { key: 'args', label: 'Its arguments, KEY:=VALUE, one a line', flag: '--arg', lines: 2 };

/** What is told of some, by what it is about. */
export const GROUPS: { title: string; fields: Field[] }[] = [
  { title: 'Limits of a servant', fields: [
    { key: 'cpus', label: "Cores that it may use, and is promised; the server's default", flag: '--cpus', example: '1.5' },
    { key: 'cpu_weight', label: 'Its share when cores are scarce, 1 to 10000; 100 by default', flag: '--cpu-weight', example: '100' },
    { key: 'cpuset', label: 'Cores that it may run on; all by default', flag: '--cpuset', example: '0-3,6' },
    { key: 'memory', label: "Memory that it may use, and is promised; the server's default", flag: '--memory', example: '512M' },
    { key: 'memory_high', label: 'Memory above which it is slowed down', flag: '--memory-high', example: '400M' },
    { key: 'pids', label: "Processes and threads; the server's default", flag: '--pids', example: '512' },
    { key: 'io_read', label: 'Bytes a second that it may read from disk', flag: '--io-read', example: '10M' },
    { key: 'io_write', label: 'Bytes a second that it may write to disk', flag: '--io-write', example: '10M' },
  ] },
  { title: 'What robots may ask for, and are promised', fields: [
    { key: 'max_cpus', label: 'Cores that a robot may ask for at most', flag: '--max-cpus', example: '2' },
    { key: 'max_memory', label: 'Memory that a robot may ask for at most', flag: '--max-memory', example: '2G' },
    { key: 'rrt', label: 'T_desire of stubs whose robot promises nothing', flag: '--rrt', example: '100ms' },
    { key: 'max_rrt', label: 'T_max of such stubs; T_desire by default', flag: '--max-rrt', example: '300ms' },
  ] },
  { title: 'How it takes the place of the revision before', fields: [
    { key: 'canary', label: 'Robots that it serves first; all at once by default', flag: '--canary', example: '10%' },
    { key: 'bound', label: 'By how much a canary may be worse, as a part; 0.1 by default', flag: '--bound', example: '0.1' },
    { key: 'samples', label: 'Requests of each before they are compared; 20 by default', flag: '--samples', example: '20' },
    { key: 'promote_after', label: 'Time after which a canary that was not worse stays; when you say so by default', flag: '--promote-after', example: '30m' },
    { key: 'deadline', label: 'Time until servants of other revisions end; when their robots leave by default', flag: '--deadline', example: '10m' },
  ] },
  { title: 'Where robots share its servants', fields: [
    { key: 'min', label: 'Servants that there are at least; 1 by default', flag: '--min', example: '1' },
    { key: 'max', label: 'Servants that there are at most; 4 by default', flag: '--max', example: '4' },
    { key: 'replicas', label: 'Servants that work at the same call; 1 by default', flag: '--replicas', example: '2' },
    { key: 'calls', label: 'Calls that one servant has under way at most; 8 by default', flag: '--calls', example: '8' },
  ] },
  { title: 'What it needs', fields: [
    { key: 'base', label: "Base image definition; the server's default", flag: '--base' },
    { key: 'remaps', label: 'Names to remap, FROM:=TO, one a line', flag: '--remap', lines: 2 },
    { key: 'map', label: 'Dependencies by hand, KEY=DEBIAN-PACKAGE, one a line', flag: '--map', lines: 2 },
    { key: 'with', label: 'Debian or ROS packages to add, one a line', flag: '--with', lines: 2 },
    { key: 'interface', label: 'What to add to the interface, as TOML or JSON', flag: '--interface', lines: 3 },
    { key: 'requests', label: 'Which input is answered by which output, INPUT=OUTPUT, one a line; as found by default', flag: '--request', example: '/image=/boxes', lines: 2 },
    { key: 'devices', label: 'Devices by their CDI names, one a line; where the operator allows them', flag: '--device', example: 'nvidia.com/gpu=0', lines: 2 },
    { key: 'volumes', label: 'Directories of the server to read, SOURCE:TARGET, one a line; where allowed', flag: '--volume', lines: 2 },
    { key: 'egress', label: 'Hosts to reach, HOST:PORT, one a line; where allowed', flag: '--egress', lines: 2 },
  ] },
];

export type Values = Record<string, string | undefined>;

export interface Chosen {
  run: 'nodes' | 'launch';
  stateful: 'asked' | 'true' | 'false';
  shared: boolean;
  idempotent: boolean;
  apt: string;
  source: string;
}

const SECONDS: Record<string, number> = { '': 1, s: 1, ms: 0.001, m: 60, min: 60, h: 3600 };

const list = (text = '') => text.split('\n').map((line) => line.trim()).filter(Boolean);
const filled = <T extends object>(of: T): T | undefined => (Object.values(of).some((one) => one !== undefined) ? of : undefined);

function pairs(text: string | undefined, sign: string, label: string): [string, string][] {
  return list(text).map((line) => {
    const at = line.indexOf(sign);
    if (at < 1) throw new Error(`${label}: ${JSON.stringify(line)} has no ${sign}`);
    return [line.slice(0, at), line.slice(at + sign.length)];
  });
}

function value(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch {
    return text;
  }
}

/**
 * What is sent of what was filled in.
 * @throws an Error that names the field where something cannot be read
 */
export function options(values: Values, chosen: Chosen): Options {
  const text = (key: string) => values[key]?.trim() || undefined;
  const figure = (key: string, label: string) => {
    const written = text(key);
    if (written === undefined) return undefined;
    const number = Number(written);
    if (!Number.isFinite(number) || number < 0) throw new Error(`${label}: ${JSON.stringify(written)} is no number`);
    return number;
  };
  const time = (key: string, label: string) => {
    const written = text(key);
    if (written === undefined) return undefined;
    const [, number, unit] = /^([0-9.]+)\s*([a-z]*)$/.exec(written) ?? [];
    const seconds = Number(number) * (SECONDS[unit ?? '?'] ?? NaN);
    if (!Number.isFinite(seconds)) throw new Error(`${label}: ${JSON.stringify(written)} is no time; write a number with ms, s, m or h, such as 10m`);
    return seconds;
  };
  const map = (key: string, sign: string, label: string) => {
    const all = pairs(values[key], sign, label);
    return all.length ? Object.fromEntries(all) : undefined;
  };
  const params = pairs(values.params, '=', 'Parameters').map(([key, written]) => [key, value(written)] as const);
  const terms = filled({
    canary: text('canary'), bound: figure('bound', '--bound'), samples: figure('samples', '--samples'),
    deadline: time('deadline', '--deadline'), promote_after: time('promote_after', '--promote-after'),
  });
  const replicas = figure('replicas', '--replicas') ?? 1;
  const min = figure('min', '--min') ?? replicas;
  return {
    name: text('name'),
    apt: chosen.apt || undefined,
    base: text('base'),
    launch: chosen.run === 'launch' ? text('launch') : undefined,
    nodes: chosen.run === 'nodes' ? list(values.nodes) : undefined,
    params: params.length ? Object.fromEntries(params) : undefined,
    args: chosen.run === 'launch' ? map('args', ':=', 'Arguments') : undefined,
    remaps: map('remaps', ':=', 'Remapped names'),
    map: map('map', '=', 'Dependencies by hand'),
    with: list(values.with),
    interface: text('interface'),
    requests: list(values.requests),
    limits: filled({
      cpus: figure('cpus', '--cpus'), cpu_weight: figure('cpu_weight', '--cpu-weight'), cpuset: text('cpuset'),
      memory: text('memory'), memory_high: text('memory_high'), pids: figure('pids', '--pids'),
      io_read: text('io_read'), io_write: text('io_write'),
    }),
    caps: filled({ cpus: figure('max_cpus', '--max-cpus'), memory: text('max_memory') }),
    sla: filled({ rrt: text('rrt'), max_rrt: text('max_rrt') }),
    grants: {
      devices: list(values.devices),
      volumes: pairs(values.volumes, ':', 'Directories').map(([source, target]) => ({ source, target })),
      egress: list(values.egress),
    },
    stateful: chosen.stateful === 'true' || undefined,
    stateless: chosen.stateful === 'false' || undefined,
    shared: chosen.shared
      ? { min, max: figure('max', '--max') ?? Math.max(4, min), idempotent: chosen.idempotent || replicas > 1, replicas, calls: figure('calls', '--calls') ?? 8 }
      : undefined,
    // The daemon takes what is not said for its default, but for these two.
    rollout: terms && { ...terms, bound: terms.bound ?? 0.1, samples: terms.samples ?? 20 },
    source: chosen.source,
  };
}
