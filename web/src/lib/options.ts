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

/** What is asked of every push, besides the package. */
export const NODES: Field = { key: 'nodes', label: 'Programs with their arguments, one per line', flag: '--node', example: 'people_detect', lines: 2 };
export const LAUNCH: Field = { key: 'launch', label: 'Launch file of the package, as for roslaunch or ros2 launch', flag: '--launch', example: 'my.launch' };
export const NAME: Field = { key: 'name', label: "Service name (default: the package's)", flag: '--name' };
/** Of launch files alone. */
export const ARGUMENTS: Field = { key: 'args', label: 'Launch arguments, KEY:=VALUE or KEY=VALUE, one per line', flag: '--arg', lines: 2 };

export interface Group {
  key: 'ros' | 'build' | 'interface' | 'limits' | 'sla' | 'rollout' | 'sharing' | 'grants';
  title: string;
  fields: Field[];
}

/** What is told of some, by what it is about. */
export const GROUPS: Group[] = [
  { key: 'ros', title: 'Parameters, launch arguments and remappings', fields: [
    { key: 'params', label: 'Parameters, KEY=VALUE or KEY:=VALUE, one per line; global ones begin with /', flag: '--param', example: 'debug_view=false', lines: 2 },
    ARGUMENTS,
    { key: 'remaps', label: 'Names to remap, FROM:=TO, one per line', flag: '--remap', lines: 2 },
  ] },
  { key: 'build', title: 'Base image and dependencies', fields: [
    { key: 'base', label: "Base image definition, which has ROS 1 or ROS 2 (default: the server's)", flag: '--base' },
    { key: 'map', label: 'Dependencies mapped by hand, KEY=PACKAGE, one per line', flag: '--map', lines: 2 },
    { key: 'with', label: 'Additional Debian or ROS packages, one per line', flag: '--with', lines: 2 },
    { key: 'packages_up_to', label: 'Packages of the workspace to build, with what they need, one per line (default: what the programs need)', flag: '--packages-up-to', lines: 2 },
    { key: 'packages_skip', label: 'Packages of the workspace not to build, one per line', flag: '--packages-skip', lines: 2 },
    { key: 'on', label: 'Underlays to build upon, one per line; the later lies above', flag: '--on', lines: 2 },
    { key: 'cmake_args', label: 'Arguments of CMake, one per line', flag: '--cmake-args', example: '-DWITH_QT=OFF', lines: 2 },
  ] },
  { key: 'interface', title: 'Topics, services and state', fields: [
    { key: 'interface', label: 'Additional interface, as TOML or JSON', flag: '--interface', lines: 3 },
    { key: 'requests', label: 'Which output answers which input, INPUT=OUTPUT, one per line (default: as detected)', flag: '--request', example: '/image=/boxes', lines: 2 },
  ] },
  { key: 'limits', title: 'Resource limits of an instance (servant)', fields: [
    { key: 'cpus', label: "CPU limit and reservation, in cores (default: the server's)", flag: '--cpus', example: '1.5' },
    { key: 'cpu_weight', label: 'CPU share under contention, 1 to 10000 (default: 100)', flag: '--cpu-weight', example: '100' },
    { key: 'cpuset', label: 'Cores to run on (default: all)', flag: '--cpuset', example: '0-3,6' },
    { key: 'memory', label: "Memory limit and reservation (default: the server's)", flag: '--memory', example: '512M' },
    { key: 'memory_high', label: 'Memory above which it is throttled', flag: '--memory-high', example: '400M' },
    { key: 'pids', label: "Processes and threads (default: the server's)", flag: '--pids', example: '512' },
    { key: 'io_read', label: 'Disk read limit, bytes per second', flag: '--io-read', example: '10M' },
    { key: 'io_write', label: 'Disk write limit, bytes per second', flag: '--io-write', example: '10M' },
  ] },
  { key: 'sla', title: 'Response times and what robots may request (SLA)', fields: [
    { key: 'rrt', label: 'Default target response time (T_desire), for robots that set none', flag: '--rrt', example: '100ms' },
    { key: 'max_rrt', label: 'Default maximum response time (T_max), for robots that set none (default: T_desire)', flag: '--max-rrt', example: '300ms' },
    { key: 'max_cpus', label: 'Maximum cores that a robot may request', flag: '--max-cpus', example: '2' },
    { key: 'max_memory', label: 'Maximum memory that a robot may request', flag: '--max-memory', example: '2G' },
  ] },
  { key: 'rollout', title: 'Rollout and canary', fields: [
    { key: 'canary', label: 'Robots served by it first (default: all at once)', flag: '--canary', example: '10%' },
    { key: 'bound', label: 'Allowed regression of a canary (default: 0.1 = 10 %)', flag: '--bound', example: '0.1' },
    { key: 'samples', label: 'Requests to each revision before they are compared (default: 20)', flag: '--samples', example: '20' },
    { key: 'promote_after', label: 'Promote automatically after (default: only by hand)', flag: '--promote-after', example: '30m' },
    { key: 'deadline', label: 'Stop servants of other revisions after (default: when their robots leave)', flag: '--deadline', example: '10m' },
  ] },
  { key: 'sharing', title: 'Replicas shared by robots', fields: [
    { key: 'min', label: 'Minimum servants (default: 1)', flag: '--min', example: '1' },
    { key: 'max', label: 'Maximum servants (default: 4)', flag: '--max', example: '4' },
    { key: 'replicas', label: 'Servants that work on the same call (default: 1)', flag: '--replicas', example: '2' },
    { key: 'calls', label: 'Concurrent calls per servant (default: 8)', flag: '--calls', example: '8' },
  ] },
  { key: 'grants', title: 'Devices, volumes and network', fields: [
    { key: 'devices', label: 'Devices by CDI name, one per line; where the operator allows them', flag: '--device', example: 'nvidia.com/gpu=0', lines: 2 },
    { key: 'volumes', label: 'Server directories to read, SOURCE:TARGET, one per line; where allowed', flag: '--volume', lines: 2 },
    { key: 'egress', label: 'Hosts to reach, HOST:PORT, one per line; where allowed', flag: '--egress', lines: 2 },
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

/** Lines of KEY=VALUE, or KEY:=VALUE as ROS writes it. */
function assignments(text: string | undefined, label: string): [string, string][] {
  return pairs(text, '=', label).map(([key, written]) => {
    const name = key.replace(/:$/, '');
    if (!name) throw new Error(`${label}: ${JSON.stringify(`${key}=${written}`)} has no name`);
    return [name, written];
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
    if (!Number.isFinite(number) || number < 0) throw new Error(`${label}: ${JSON.stringify(written)} is not a number`);
    return number;
  };
  const time = (key: string, label: string) => {
    const written = text(key);
    if (written === undefined) return undefined;
    const [, number, unit] = /^([0-9.]+)\s*([a-z]*)$/.exec(written) ?? [];
    const seconds = Number(number) * (SECONDS[unit ?? '?'] ?? NaN);
    if (!Number.isFinite(seconds)) throw new Error(`${label}: ${JSON.stringify(written)} is not a time; write a number with ms, s, m or h, such as 10m`);
    return seconds;
  };
  const map = (key: string, sign: string, label: string) => {
    const all = pairs(values[key], sign, label);
    return all.length ? Object.fromEntries(all) : undefined;
  };
  const params = assignments(values.params, 'Parameters').map(([key, written]) => [key, value(written)] as const);
  const args = assignments(values.args, 'Arguments');
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
    args: chosen.run === 'launch' && args.length ? Object.fromEntries(args) : undefined,
    remaps: map('remaps', ':=', 'Remapped names'),
    map: map('map', '=', 'Dependencies mapped by hand'),
    with: list(values.with),
    packages_up_to: list(values.packages_up_to),
    packages_skip: list(values.packages_skip),
    on: list(values.on),
    cmake_args: list(values.cmake_args),
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
