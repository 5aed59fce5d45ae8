// What the daemon says, as far as the page shows it: crate `api`, documented at /api/v1/openapi.json. Times are in milliseconds
// since 1970, sizes in bytes.

export interface Session {
  name?: string;
  role?: string;
  csrf?: string;
  needed: boolean;
  accounts: boolean;
  /** An identity provider that knows people, too. */
  provider?: { name: string; path: string };
}

export interface Limits {
  cpus?: number;
  cpu_weight?: number;
  memory?: number;
  memory_high?: number;
  pids?: number;
  io_read?: number;
  io_write?: number;
  cpuset?: string;
}

export interface Pressure { cpu: number; memory: number; io: number }

export interface Usage {
  cpu_usec: number;
  memory: number;
  pids: number;
  oom_kills: number;
  throttled_usec: number;
  pressure?: Pressure;
}

export interface Machine {
  version: string;
  home: string;
  listen: string;
  certificate?: string;
  default_service?: string;
  started: number;
  isolation: { mode: string; cgroup_version: number; missing: string[] };
  capacity: { cpus: number; memory: number; cpus_reserved: number; memory_reserved: number; waiting: number };
  services: number;
  servants: number;
  warm_pool: number;
  warm_nodes: number;
  connections: number;
  usage: Usage;
  warnings: string[];
  cores: number;
  host_cores: number;
  host_memory?: number;
  host_memory_available?: number;
}

export interface ServiceSummary {
  name: string;
  address: string;
  package: string;
  revision: number;
  image: string;
  published: number;
  topics: number;
  services: number;
  actions: number;
  parameters: number;
  servants: number;
  limits: Limits;
}

export interface Qos { reliability: string; durability: string; liveliness: string; deadline?: number; lifespan?: number; lease?: number }
export interface Topic { name: string; type: string; direction: 'input' | 'output'; latched: boolean; lazy: boolean; qos?: Qos }
export interface Descriptor { type: string; description: string; constraints: string; read_only: boolean; range?: { from?: number; to?: number; step?: number } }
export interface Typed { name: string; type: string; node?: string }

export interface ServiceDetail extends ServiceSummary {
  revisions: Revision[];
  nodes: { name: string; argv: string[] }[];
  interface: {
    topics: Topic[];
    services: Typed[];
    actions: Typed[];
    parameters: { name: string; value?: unknown; descriptor?: Descriptor }[];
    lifecycle: string[];
    needs: { name: string; nodes: string[] }[];
    requests: { node: string; input: string; outputs: string[]; by: string; reason: string }[];
  };
}

export type Phase = 'requested' | 'admitted' | 'created' | 'starting' | 'ready' | 'draining' | 'stopped' | 'failed';

export interface Servant {
  id: string;
  service: string;
  revision: number;
  robot: string;
  phase: Phase;
  reason?: string;
  created: number;
  connections: number;
  idle_until?: number;
  terms?: { stated: Record<string, { sla?: { rrt?: string; max_rrt?: string } }>; class?: string; priority: number; limits: Limits; why?: string[] };
  limits: Limits;
  enforced?: Limits;
  cgroup_version: number;
  usage?: Usage;
  response?: { requests: number; p50_ms: number; p95_ms: number };
  pids: number[];
  dropped: number;
  drops?: { topic: string; count: number }[];
  down: { node: string; failures: number; again: number }[];
  hung: string[];
  lifecycle: { node: string; state: string; refused?: string }[];
}

export interface Part { name: string; p50: number; p90: number; max: number }

export interface Link {
  node: string;
  up: boolean;
  round_trip?: number;
  dropped: number;
  drops: string[];
  desire?: number;
  max?: number;
  threshold?: number;
  satisfaction?: number;
  requests: number;
  late: number;
  local: number;
  phases: Part[];
}

export interface Served { servant: Servant; throttled: number; cores: number; links: Link[] }

export interface BackOff { service: string; revision: number; robot: string; failures: number; reason: string; again: number }

export type Level = 'info' | 'warning' | 'error';

export interface Event {
  id: number;
  time: number;
  level: Level;
  kind: string;
  service?: string;
  servant?: string;
  robot?: string;
  message: string;
}

export interface Update {
  time: number;
  machine?: Machine;
  services?: ServiceSummary[];
  services_gone?: string[];
  servants?: Served[];
  servants_gone?: string[];
  back_offs?: BackOff[];
  events?: Event[];
}

export interface LogLine { time: number; node: string; stream: 'stdout' | 'stderr'; line: string }

export interface Cause { weight: 'blocks' | 'slows' | 'hint'; what: string; next: string }
export interface Explanation { robot: string; causes: Cause[]; servants: Served[]; events: Event[] }

export interface Fit {
  cpus: number;
  memory: number;
  free_cpus: number;
  free_memory: number;
  waiting: number;
  stalled?: string;
  never?: string;
  full: boolean;
  now: boolean;
  ends: string[];
  lacking_cpus: number;
  lacking_memory: number;
  costs: { servant: string; service: string; robot: string; cpus: number; left: number; rrt?: number; later?: number; accepts?: number }[];
  more?: number;
  beyond_cpus?: number;
  beyond_memory?: number;
  expected?: { rrt: number; from: string };
  shared?: number;
}

export interface Row {
  id: number;
  measure: 'rrt' | 'fps' | 'age';
  value: number;
  aux?: Record<string, string>;
  limits: Limits;
  spread?: { p50: number; p95: number; requests: number };
  revision?: number;
  written: number;
}

export interface Arm { servants: number; servants_failed: number; requests: number; requests_failed: number; p50?: number; p95?: number }

export interface Rollout {
  stable: number;
  candidate: number;
  state: string;
  reason: string;
  waits?: string;
  started: number;
  of_stable: Arm;
  of_candidate: Arm;
}

export interface Revision { number: number; image: string; published: number; source: string; current: boolean }
export interface Difference { part: string; name: string; before?: string; after?: string }
export interface Differences { service: string; from: number; to: number; differences: Difference[] }

export interface Token { name: string; role: string; services: string[]; robot?: string; classes: string[]; created: number; expires?: number; last_used?: number; revoked?: number }
export interface Account { name: string; role: string; services: string[]; created: number; last_login?: number; disabled?: number; sessions: number }
export interface Rule { id: number; who: string; services: string; allow: string[] }
export interface Pairing { robot: string; services: string[]; state: 'waiting' | 'paired'; own_certificate: boolean; created: number; expires?: number; last_used?: number }
export interface Audited { id: number; time: number; who: string; from: string; action: string; did: string; object: string; status: number; more?: number }

export interface TimeSpread { p50: number; p95: number; max: number }
export interface Point { cpus: number; requests: number; answered: number; compute?: TimeSpread; running: number; throttled: number; rate: number; memory: number }

export interface Calibration {
  service: string;
  revision: number;
  unused: string[];
  points: Point[];
  ended: string;
  memory_peak: number;
  memory_margin: number;
  rows: Row[];
}

type Figures<K extends string> = { time: number[] } & Record<K, (number | null)[]>;

/** A time in which a robot's node was served by its local original. */
export interface LocalPeriod {
  node: string;
  began: number;
  ended?: number;
  why: string;
}

export interface ServantHistory {
  servant: string;
  service: string;
  robot: string;
  began: number;
  seen: number;
  step: number;
  figures: Figures<'cores' | 'throttled' | 'memory' | 'p50' | 'p95' | 'desire' | 'max' | 'satisfaction' | 'dropped' | 'serialise' | 'up' | 'queue' | 'compute' | 'down'>;
  local: LocalPeriod[];
}

export interface MachineHistory {
  step: number;
  figures: Figures<'cores' | 'promised' | 'memory' | 'cpu_waits' | 'memory_waits' | 'io_waits'>;
}

/** A file of the last seconds of a servant. */
export interface Recording { number: number; service: string; robot: string; servant: string; time: number; why: string; seconds: number; messages: number; bytes: number }

/** A goal of an action that a servant was sent. */
export interface Goal { action: string; id: string; by: string; began: number; ended?: number; state: 'underway' | 'preempted' | 'succeeded' | 'aborted' | 'rejected' | 'recalled' | 'lost'; text?: string }

/** What was published on a topic in a second; latency in seconds. */
export interface TopicFigures { topic: string; type: string; rate: number; bandwidth: number; latency?: number }
