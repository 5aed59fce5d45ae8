// Types of the API, written by `make types` from the schemas of /api/v1/openapi.json. Do not edit.
// Members are described there. One that is not known is left out: null stands in lists only.

export interface Account {
  created: Millis;
  disabled?: Millis;
  last_login?: Millis;
  name: string;
  role: string;
  services: string[];
  sessions: number;
}

export interface AccountChange {
  disabled?: boolean;
  password?: string;
  role?: string;
  services?: string[];
}

export interface Action {
  name: string;
  node: string;
  type: string;
}

export interface Arm {
  p50?: number;
  p95?: number;
  requests: number;
  requests_failed: number;
  servants: number;
  servants_failed: number;
}

export interface Audited {
  action: string;
  did: string;
  from: string;
  id: number;
  more?: number;
  object: string;
  status: number;
  time: Millis;
  who: string;
}

export interface BackOff {
  again: Millis;
  failures: number;
  reason: string;
  revision: number;
  robot: string;
  service: string;
}

export interface BaseDetail extends BaseSummary {
  debian_packages: Record<string, string>;
  findings: BaseFinding[];
  includes: string[];
  python_packages: Record<string, string>;
  ros_packages: Record<string, string>;
}

export interface BaseFinding {
  consequence: string;
  found: string;
  subject: string;
}

export type BaseState =
  | 'not-set-up'
  | 'ready'
  | 'imported';

export interface BaseSummary {
  bytes: Size;
  distribution: string;
  name: string;
  ros: number;
  state: BaseState;
  summary: string;
  system: string;
  toolchain: boolean;
}

export interface Calibration {
  ended: string;
  inputs: Fed[];
  largest: Size;
  memory_margin: number;
  memory_peak: Size;
  network?: TimeSpread;
  pace?: number;
  points: Point[];
  revision: number;
  rows: Row[];
  service: string;
  unused: string[];
}

export type CalibrationEvent =
  | { title: string; type: 'step' }
  | { point: Point; times?: number[]; type: 'measured' }
  | { calibration: Calibration; servant: string; type: 'kept' }
  | { calibration: Calibration; type: 'done' }
  | { problem: Problem; type: 'error' };

export interface CalibrationOptions {
  aux?: Record<string, string>;
  bytes?: Size;
  cpus?: number[];
  fast?: boolean;
  input?: string;
  keep?: number;
  memory?: Size;
  network?: number;
  own?: boolean;
  rate?: number;
  requests?: number;
  robot?: string;
  seconds?: number;
  source?: Source;
  times?: boolean;
}

export interface Capacity {
  cpus: number;
  cpus_reserved: number;
  memory: number;
  memory_reserved: number;
  waiting: number;
}

export interface Caps {
  cpus?: number;
  memory?: Size;
}

export interface Cause {
  next: string;
  weight: Weight;
  what: string;
}

export interface Check {
  fix?: string;
  found: string;
  name: string;
  status: CheckStatus;
}

export type CheckStatus =
  | 'ok'
  | 'warning'
  | 'missing';

export interface Clock {
  now: number;
}

export interface Compared {
  candidate?: TimeSpread;
  different: number;
  equal: number;
  fields: FieldDifference[];
  kind: Kind;
  missing: number;
  name: string;
  present?: TimeSpread;
  surplus: number;
}

export interface Considered {
  row: Row;
  taken: boolean;
  why: string;
}

export interface Cost {
  accepts?: number;
  cpus: number;
  later?: number;
  left: number;
  robot: string;
  rrt?: number;
  servant: string;
  service: string;
}

export type CpuSet = string;

export interface Descriptor {
  constraints: string;
  description: string;
  dynamic_typing: boolean;
  range?: Range;
  read_only: boolean;
  type: string;
}

export interface Difference {
  after?: string;
  before?: string;
  name: string;
  part: RevisionPart;
}

export interface Differences {
  differences: Difference[];
  from: number;
  service: string;
  to: number;
}

export type Direction =
  | 'input'
  | 'output';

export interface Doctor {
  checks: Check[];
}

export type Durability =
  | 'volatile'
  | 'transient_local';

export interface Event {
  id: number;
  kind: string;
  level: Level;
  message: string;
  robot?: string;
  servant?: string;
  service?: string;
  time: Millis;
}

export interface Expected {
  from: string;
  rrt: number;
}

export interface Explained {
  class?: string;
  goals: ExplainedGoal[];
  limits?: Limits;
  next: string[];
  priority: number;
  refused?: string;
  service: string;
  stated: Stated;
  why: string[];
}

export interface ExplainedGoal {
  bound: number;
  desire: number;
  measure: Measure;
  rows: Considered[];
}

export interface Explanation {
  causes: Cause[];
  events: Event[];
  robot: string;
  servants: Served[];
}

export interface Fed {
  from: string[];
  sent: number;
  topic: string;
  type: string;
}

export interface FieldDifference {
  answers: number;
  candidate: string;
  field: string;
  present: string;
}

export interface Fit {
  at_present_use?: UseForecast;
  beyond_cpus: number;
  beyond_memory: Size;
  costs: Cost[];
  cpus: number;
  ends: string[];
  expected?: Expected;
  free_cpus: number;
  free_memory: Size;
  full: boolean;
  lacking_cpus: number;
  lacking_memory: Size;
  memory: Size;
  more?: number;
  never?: string;
  now: boolean;
  shared?: number;
  stalled?: string;
  waiting: number;
}

export interface Goal {
  action: string;
  began: Millis;
  by: string;
  ended?: Millis;
  id: string;
  state: GoalState;
  text?: string;
}

export type GoalState =
  | 'underway'
  | 'preempted'
  | 'succeeded'
  | 'aborted'
  | 'rejected'
  | 'recalled'
  | 'lost';

export interface Grants {
  devices?: string[];
  egress?: string[];
  volumes?: Volume[];
}

export interface Group {
  answered: number;
  asked_again: number;
  failed: number;
  mean_ms?: number;
  revision: number;
  robots: number;
  servants: GroupServant[];
  waiting: number;
  wasted: number;
}

export interface GroupServant {
  id: string;
  ready: boolean;
  retiring: boolean;
  under_way: number;
}

export interface Heard {
  bytes: number;
  last?: unknown;
  received: number;
  topic: string;
  type: string;
}

export interface Interface {
  actions: Action[];
  lifecycle: string[];
  needs: Need[];
  parameters: Parameter[];
  requests: Request[];
  services: RosService[];
  topics: Topic[];
}

export interface Isolation {
  cgroup_version: number;
  missing: string[];
  mode: string;
}

export interface KeptLog {
  bytes: Size;
  created: Millis;
  ended: Millis;
  failed: boolean;
  reason: string;
  revision: number;
  robot: string;
  servant: string;
  service: string;
}

export type Kind =
  | 'topic'
  | 'service'
  | 'action';

export interface Layer {
  cached: boolean;
  digest: string;
  name: string;
  size: number;
}

export type Level =
  | 'info'
  | 'warning'
  | 'error';

export interface Limits {
  cpu_weight?: number;
  cpus?: number;
  cpuset?: CpuSet;
  io_read?: Size;
  io_write?: Size;
  memory?: Size;
  memory_high?: Size;
  pids?: number;
}

export interface Link {
  age?: number;
  clock?: number;
  desire?: number;
  desired_age?: number;
  desired_frames_per_second?: number;
  dropped: number;
  drops: string[];
  duplicates: string[];
  fallback_after?: number;
  frames_per_second?: number;
  given: number;
  late: number;
  late_in?: Part;
  left_out: number;
  local: number;
  max?: number;
  node: string;
  phases: Part[];
  refused: string[];
  requests: number;
  round_trip?: number;
  satisfaction?: number;
  threshold?: number;
  throughput?: number;
  trace?: string;
  unfed: string[];
  unsent: number;
  unserved: string[];
  up: boolean;
}

export type Liveliness =
  | 'automatic'
  | 'manual_by_topic';

export interface LocalPeriod {
  began: Millis;
  ended?: Millis;
  node: string;
  why: string;
}

export type LogLevel =
  | 'debug'
  | 'info'
  | 'warn'
  | 'error'
  | 'fatal';

export interface LogLine {
  level?: LogLevel;
  line: string;
  node: string;
  stream: Stream;
  time: Millis;
}

export interface Machine extends Status {
  cores: number;
  host_cores: number;
  host_memory?: number;
  host_memory_available?: number;
}

export interface MachineFigures {
  cores: (number | null)[];
  cores_most: (number | null)[];
  cpu_waits: (number | null)[];
  io_waits: (number | null)[];
  memory: (number | null)[];
  memory_waits: (number | null)[];
  promised: (number | null)[];
  servants: (number | null)[];
  time: number[];
}

export interface MachineHistory {
  figures: MachineFigures;
  step: number;
}

export type Measure =
  | 'rrt'
  | 'fps'
  | 'age';

export type Millis = number;

export interface Need {
  name: string;
  nodes: string[];
}

export interface NewAccount {
  name: string;
  password: string;
  role: string;
  services?: string[];
}

export interface NewPairing {
  address?: string;
  classes?: string[];
  lifetime?: number;
  own_certificate?: boolean;
  robot: string;
  services: string[];
}

export interface NewRows {
  replace?: boolean;
  rows: Row[];
}

export interface NewRule {
  allow: string[];
  services: string;
  who: string;
}

export interface NewToken {
  classes?: string[];
  lifetime?: number;
  name: string;
  robot?: string;
  role: string;
  services?: string[];
}

export interface Node {
  argv: string[];
  name: string;
}

export interface NodeDown {
  again: Millis;
  failures: number;
  node: string;
}

export interface NodeStage {
  node: string;
  refused?: string;
  state: string;
}

export interface NotCompared {
  count: number;
  what: string;
  why: string;
}

export interface Pair {
  code: string;
  request: string;
  robot: string;
}

export interface Pairing {
  classes: string[];
  created: Millis;
  expires?: Millis;
  last_used?: Millis;
  own_certificate: boolean;
  robot: string;
  services: string[];
  state: PairingState;
}

export interface PairingMade {
  expires?: Millis;
  line?: string;
  robot: string;
}

export type PairingState =
  | 'waiting'
  | 'paired';

export interface Parameter {
  descriptor?: Descriptor;
  name: string;
  node?: string;
  value?: unknown;
}

export interface Part {
  max: number;
  name: string;
  p50: number;
  p90: number;
}

export type Phase =
  | 'requested'
  | 'admitted'
  | 'created'
  | 'starting'
  | 'ready'
  | 'draining'
  | 'stopped'
  | 'failed';

export interface Point {
  answered: number;
  compute?: TimeSpread;
  cpus: number;
  memory: Size;
  rate: number;
  requests: number;
  running: number;
  throttled: number;
}

export interface Pressure {
  cpu: number;
  io: number;
  memory: number;
}

export interface Problem {
  detail: string;
  exists?: string[];
  log?: string[];
  next?: string;
  retry_after?: number;
  status: number;
  title: string;
  type: string;
}

export interface ProviderLink {
  name: string;
  path: string;
}

export interface PublishedTopic {
  bandwidth: number;
  latency?: number;
  rate: number;
  topic: string;
  type: string;
}

export interface PublishedTopics {
  seconds: number;
  topics: PublishedTopic[];
}

export interface PushCount {
  done: number;
  total?: number;
  unit: string;
}

export type PushEvent =
  | { number: number; type: 'accepted' }
  | { last_took?: number; title: string; type: 'step' }
  | { line: string; type: 'log' }
  | { done: number; total?: number; type: 'progress'; unit: string }
  | { message: string; type: 'warning' }
  | { layers: Layer[]; service: ServiceDetail; took: number; type: 'done'; unchanged?: boolean }
  | { layers: Layer[]; took: number; type: 'underlay'; unchanged?: boolean; underlay: Underlay }
  | { problem: Problem; type: 'error' };

export interface PushOptions {
  apt?: string;
  args?: Record<string, string>;
  as_underlay?: string;
  base?: string;
  caps?: Caps;
  cmake_args?: string[];
  created?: number;
  grants?: Grants;
  interface?: string;
  launch?: string;
  limits?: Limits;
  map?: Record<string, string>;
  name?: string;
  nodes?: string[];
  on?: string[];
  packages_skip?: string[];
  packages_up_to?: string[];
  params?: Record<string, unknown>;
  remaps?: Record<string, string>;
  requests?: string[];
  rollout?: RolloutTerms;
  shared?: Shared;
  sla?: Sla;
  source?: string;
  stateful?: boolean;
  stateless?: boolean;
  with?: string[];
}

export type PushState =
  | 'running'
  | 'published'
  | 'failed'
  | 'cancelled';

export interface PushStatus {
  began: Millis;
  by: string;
  can_cancel: boolean;
  can_read: boolean;
  ended?: Millis;
  last_took?: number;
  message?: string;
  number: number;
  progress?: PushCount;
  service?: string;
  source: string;
  state: PushState;
  step: string;
  step_began?: Millis;
}

export interface Qos {
  deadline?: number;
  durability: Durability;
  lease?: number;
  lifespan?: number;
  liveliness: Liveliness;
  reliability: Reliability;
}

export interface Range {
  from?: number;
  step?: number;
  to?: number;
}

export interface Recording {
  bytes: Size;
  messages: number;
  number: number;
  robot: string;
  seconds: number;
  servant: string;
  service: string;
  time: Millis;
  why: string;
}

export type Reliability =
  | 'best_effort'
  | 'reliable';

export interface Renew {
  request: string;
}

export interface Request {
  by: string;
  input: string;
  node: string;
  outputs: string[];
  reason: string;
}

export interface ResponseTimes {
  p50_ms: number;
  p95_ms: number;
  requests: number;
}

export interface Revision {
  current: boolean;
  image: string;
  number: number;
  published: Millis;
  source: string;
}

export type RevisionPart =
  | 'push'
  | 'node'
  | 'topic'
  | 'service'
  | 'action'
  | 'need'
  | 'definition'
  | 'parameter'
  | 'limit'
  | 'cap'
  | 'sla'
  | 'grant'
  | 'shared'
  | 'environment'
  | 'package';

export interface RobotCertificate {
  certificate: string;
  expires: Millis;
  issued: Millis;
  robot: string;
}

export interface Rollback {
  revision?: number;
}

export interface Rollout {
  candidate: number;
  changed: Millis;
  of_candidate: Arm;
  of_stable: Arm;
  reason: string;
  service: string;
  stable: number;
  started: Millis;
  state: RolloutState;
  terms: RolloutTerms;
  waits?: string;
}

export type RolloutOrder =
  | { order: 'start'; revision: number; terms?: RolloutTerms }
  | { order: 'promote' }
  | { order: 'abort' };

export type RolloutState =
  | 'canary'
  | 'draining'
  | 'promoted'
  | 'rolled-back'
  | 'aborted'
  | 'replaced';

export interface RolloutTerms {
  bound?: number;
  canary?: Share;
  deadline?: number;
  promote_after?: number;
  samples?: number;
}

export interface RosService {
  name: string;
  node: string;
  type: string;
}

export interface Row {
  aux?: Record<string, string>;
  id?: number;
  limits: Limits;
  measure: Measure;
  revision?: number;
  spread?: Spread;
  value: number;
  written?: Millis;
}

export interface Rule {
  allow: string[];
  id: number;
  services: string;
  who: string;
}

export interface Secret {
  secret: string;
  token: Token;
}

export interface Servant {
  cgroup_version: number;
  connections: number;
  created: Millis;
  down: NodeDown[];
  dropped: number;
  drops: TopicDrops[];
  enforced?: Limits;
  hung: string[];
  id: string;
  idle_until?: Millis;
  lifecycle: NodeStage[];
  limits: Limits;
  phase: Phase;
  pids: number[];
  reason?: string;
  response?: ResponseTimes;
  revision: number;
  robot: string;
  service: string;
  terms?: Terms;
  usage?: Usage;
}

export interface ServantFigures {
  compute: (number | null)[];
  cores: (number | null)[];
  cores_most: (number | null)[];
  desire: (number | null)[];
  down: (number | null)[];
  dropped: (number | null)[];
  max: (number | null)[];
  memory: (number | null)[];
  p50: (number | null)[];
  p95: (number | null)[];
  queue: (number | null)[];
  satisfaction: (number | null)[];
  serialise: (number | null)[];
  throttled: (number | null)[];
  time: number[];
  up: (number | null)[];
}

export interface ServantHistory {
  began: Millis;
  figures: ServantFigures;
  local: LocalPeriod[];
  robot: string;
  seen: Millis;
  servant: string;
  service: string;
  step: number;
}

export interface Served {
  cores: number;
  links: Link[];
  servant: Servant;
  throttled: number;
}

export interface ServiceDetail extends ServiceSummary {
  groups?: Group[];
  interface: Interface;
  nodes: Node[];
  revisions: Revision[];
  rollout: boolean;
  shared?: Shared;
}

export interface ServiceSummary {
  actions: number;
  address: string;
  image: string;
  limits: Limits;
  name: string;
  package: string;
  parameters: number;
  published: Millis;
  revision: number;
  servants: number;
  services: number;
  topics: number;
}

export interface Session {
  accounts: boolean;
  csrf?: string;
  expires?: Millis;
  loopback_robots: boolean;
  name?: string;
  needed: boolean;
  provider?: ProviderLink;
  role?: string;
}

export interface SessionLine {
  created: Millis;
  expires: Millis;
  from: string;
  id: number;
  last_used: Millis;
  name: string;
  role: string;
}

export interface Shadow {
  candidate: number;
  compared: Compared[];
  ended: string;
  given: number;
  not_compared: NotCompared[];
  revision: number;
  robot: string;
  seconds: number;
  service: string;
  verdict: Verdict;
  why: string;
}

export type ShadowEvent =
  | { title: string; type: 'step' }
  | { shadow: Shadow; type: 'done' }
  | { problem: Problem; type: 'error' };

export interface ShadowOptions {
  acting?: boolean;
  bound?: number;
  ignore?: string[];
  requests?: number;
  revision?: number;
  robot?: string;
  seconds?: number;
  tolerance?: number;
}

export type Share = string;

export interface Shared {
  calls?: number;
  idempotent?: boolean;
  max?: number;
  min?: number;
  replicas?: number;
}

export interface SignIn {
  name: string;
  password: string;
}

export type Size = number;

export interface Sla {
  age?: string;
  fps?: number;
  max_age?: string;
  max_rrt?: string;
  min_fps?: number;
  rrt?: string;
}

export type Source =
  | 'bag'
  | 'frames'
  | 'live';

export interface Spread {
  p50: number;
  p95: number;
  requests: number;
}

export interface StandingService {
  on: number;
  service: string;
}

export interface Stated {
  aux?: Record<string, string>;
  class?: string;
  cpus?: number;
  memory?: Size;
  sla?: Sla;
}

export interface Status {
  architecture: string;
  black_box: number;
  capacity: Capacity;
  certificate?: string;
  connections: number;
  default_service?: string;
  home: string;
  isolation: Isolation;
  limits: Limits;
  listen: string;
  pid: number;
  servants: number;
  services: number;
  started: Millis;
  usage: Usage;
  version: string;
  warm_nodes: number;
  warm_pool: number;
  warnings: string[];
}

export interface Stopped {
  stopped: string[];
}

export type Stream =
  | 'stdout'
  | 'stderr';

export interface Terms {
  class?: string;
  limits: Limits;
  measured?: Record<string, string>;
  priority: number;
  rows?: Row[];
  stated: Record<string, Stated>;
  why?: string[];
}

export interface TimeSpread {
  max: number;
  p50: number;
  p95: number;
}

export interface Times {
  acceptable: number;
  desire: number;
  max: number;
  p50: number;
  p90: number;
}

export interface Token {
  classes: string[];
  created: Millis;
  expires?: Millis;
  last_used?: Millis;
  name: string;
  revoked?: Millis;
  robot?: string;
  role: string;
  services: string[];
}

export interface Topic {
  direction: Direction;
  latched: boolean;
  lazy: boolean;
  md5: string;
  name: string;
  qos?: Qos;
  type: string;
}

export interface TopicDrops {
  count: number;
  topic: string;
}

export interface Trial {
  answered: number;
  inputs: Fed[];
  outputs: Heard[];
  requests: number;
  rrt?: Times;
  service: string;
  unused: string[];
}

export interface Underlay {
  base: string;
  bytes: Size;
  distribution: string;
  name: string;
  packages: string[];
  published: u64;
  revision: number;
  ros: number;
  services: StandingService[];
  source: string;
}

export interface Update {
  back_offs?: BackOff[];
  events?: Event[];
  machine?: Machine;
  servants?: Served[];
  servants_gone?: string[];
  services?: ServiceSummary[];
  services_gone?: string[];
  time: Millis;
}

export interface Usage {
  cpu_usec: number;
  memory: number;
  oom_kills: number;
  pids: number;
  pressure?: Pressure;
  throttled_usec: number;
}

export interface UseForecast {
  cpus?: number;
  more?: number;
  unused_cpus: number;
}

export type Verdict =
  | 'nothing'
  | 'equal'
  | 'slower'
  | 'different'
  | 'failed';

export interface Volume {
  source: string;
  target: string;
}

export type Weight =
  | 'blocks'
  | 'slows'
  | 'hint';

export interface Whoami {
  may: string[];
  name: string;
  robot?: string;
  roles: string[];
  services: string[];
}

export type u64 = number;
