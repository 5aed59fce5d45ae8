//! Samples of every type described by the document, one or more each.

mod machines;
mod observed;
mod pushes;

use std::sync::Arc;

use api::access::{Audited, NewRule, NewToken, Rule, Secret, Token, Whoami};
use api::bases::{BaseDetail, BaseFinding, BaseState, BaseSummary};
use api::calibration::{Calibration, Point, Source, TimeSpread};
use api::dictionary::{Considered, Explained, ExplainedGoal, NewRows, Row, Spread};
use api::explain::{Cause, Explanation, Link, Part, Served, Weight};
use api::interface::{Action, Direction, Interface, Need, Parameter, Service, Topic};
use api::people::{Account, AccountChange, NewAccount, ProviderLink, Session, SessionLine, SignIn};
use api::push::Layer;
use api::rollout::{Arm, Rollout, RolloutOrder, RolloutState, RolloutTerms, Share};
use api::shadow::{Compared, FieldDifference, NotCompared};
use api::stream::{Machine, Update};
use api::trial::{Fed, Heard, Times, Trial};
use api::{
    BackOff, CalibrationEvent, CalibrationOptions, Capacity, Caps, Check, CheckStatus, Clock, Cost, Doctor, Event,
    Expected, Fit, Grants, Isolation, Level, Limits, LogLevel, LogLine, Measure, Node, NodeDown, Phase, Pressure,
    Problem, PushEvent, PushOptions, Revision, Rollback, Servant, ServiceDetail, ServiceSummary, Shadow, ShadowEvent,
    ShadowOptions, Size, Sla, Span, StandingService, Stated, Status, Stopped, Stream, Terms, Underlay, Usage,
    UseForecast, Volume,
};
use serde_json::Value;

fn some_text(text: &str) -> Option<String> {
    Some(text.to_owned())
}

fn one_text(text: &str) -> Vec<String> {
    vec![text.to_owned()]
}

fn limits() -> Limits {
    Limits {
        cpus: Some(1.5),
        cpu_weight: Some(100),
        memory: Some(Size(512 << 20)),
        memory_high: Some(Size(256 << 20)),
        pids: Some(64),
        io_read: Some(Size(1 << 20)),
        io_write: Some(Size(1 << 20)),
        cpuset: Some("0-3,6".parse().expect("a set")),
    }
}

fn usage() -> Usage {
    Usage { pressure: Some(Pressure::default()), ..Usage::default() }
}

fn event() -> Event {
    Event {
        id: 7,
        time: 1,
        level: Level::Warning,
        kind: "servant-ready".into(),
        service: some_text("opencv_apps"),
        servant: some_text("opencv_apps-1"),
        robot: some_text("r1"),
        message: "it is ready".into(),
    }
}

fn servant() -> Servant {
    Servant {
        id: "opencv_apps-1".into(),
        service: "opencv_apps".into(),
        revision: 1,
        robot: "r1".into(),
        phase: Phase::Ready,
        reason: some_text("it was stopped"),
        created: 1,
        connections: 1,
        idle_until: Some(2),
        terms: Some(terms()),
        limits: limits(),
        enforced: Some(limits()),
        cgroup_version: 2,
        usage: Some(usage()),
        response: Some(api::ResponseTimes { requests: 1, p50_ms: 1.5, p95_ms: 1.5 }),
        pids: vec![1],
        dropped: 1,
        drops: vec![api::TopicDrops { topic: "/x".into(), count: 1 }],
        hung: vec!["/x answered none of 3 inputs in 1.0 s".into()],
        lifecycle: vec![api::NodeStage {
            node: "/x".into(),
            state: "inactive".into(),
            refused: Some("it did not activate".into()),
        }],
        down: vec![NodeDown { node: "/x".into(), failures: 2, again: 1 }],
    }
}

fn rollout_terms() -> RolloutTerms {
    RolloutTerms {
        canary: Some(Share::Percent(10.0)),
        deadline: Some(1.5),
        promote_after: Some(1.5),
        ..RolloutTerms::default()
    }
}

fn rollout() -> Rollout {
    let arm = Arm { p50: Some(1.5), p95: Some(1.5), ..Arm::default() };
    Rollout {
        service: "x".into(),
        stable: 1,
        candidate: 2,
        state: RolloutState::RolledBack,
        reason: "it was worse".into(),
        waits: some_text("it has had 3 requests"),
        started: 1,
        changed: 1,
        terms: rollout_terms(),
        of_stable: Arm::default(),
        of_candidate: arm,
    }
}

fn back_off() -> BackOff {
    BackOff { service: "x".into(), revision: 1, robot: "r1".into(), failures: 2, reason: "ended".into(), again: 1 }
}

fn terms() -> Terms {
    let stated = Stated {
        sla: Sla {
            rrt: Span::from_millis(100),
            max_rrt: Span::from_millis(300),
            fps: Some(5.0),
            min_fps: Some(2.0),
            age: Span::from_millis(100),
            max_age: Span::from_millis(300),
        },
        class: some_text("default"),
        cpus: Some(1.0),
        memory: Some(Size(1 << 30)),
        aux: [("width".to_owned(), "640".to_owned())].into(),
    };
    Terms {
        stated: [("/n".to_owned(), stated)].into(),
        measured: [("width".to_owned(), "640".to_owned())].into(),
        class: some_text("default"),
        priority: 1,
        rows: vec![row()],
        limits: limits(),
        why: one_text("cpus 1 as requested"),
    }
}

fn row() -> Row {
    Row {
        id: 1,
        measure: Measure::Rrt,
        value: 0.1,
        aux: [("width".to_owned(), "640".to_owned())].into(),
        limits: limits(),
        spread: Some(Spread { p50: 0.05, p95: 0.1, requests: 100 }),
        revision: Some(1),
        written: 1,
    }
}

fn new_rows() -> NewRows {
    let bare = Row { id: 0, aux: Default::default(), spread: None, revision: None, ..row() };
    NewRows { rows: vec![row(), bare], replace: true }
}

fn explained_sla() -> Explained {
    Explained {
        service: "x".into(),
        stated: Stated::default(),
        class: some_text("default"),
        priority: 1,
        limits: Some(limits()),
        why: one_text("as requested"),
        refused: some_text("there is none"),
        next: one_text("better: entry 2"),
        goals: vec![ExplainedGoal {
            measure: Measure::Fps,
            desire: 5.0,
            bound: 2.0,
            rows: vec![Considered { row: row(), taken: true, why: "taken".into() }],
        }],
    }
}

fn history() -> api::history::ServantHistory {
    api::history::ServantHistory {
        servant: "s1".into(),
        service: "s".into(),
        robot: "r".into(),
        began: 1,
        seen: 2,
        step: 60,
        figures: api::history::ServantFigures { time: vec![1, 2], cores: vec![Some(0.5), None], ..Default::default() },
        local: [None, Some(2)]
            .map(|ended| api::history::LocalPeriod {
                node: "/n".into(),
                began: 1,
                ended,
                why: "the link is down".into(),
            })
            .into(),
    }
}

fn detail() -> ServiceDetail {
    let (name, type_name, node) = ("/x".to_owned(), "p/T".to_owned(), "/n".to_owned());
    ServiceDetail {
        summary: ServiceSummary {
            name: name.clone(),
            address: "ws://127.0.0.1:9090/x".into(),
            package: "x".into(),
            revision: 1,
            image: "sha256:0".into(),
            published: 1,
            topics: 1,
            services: 1,
            actions: 1,
            parameters: 1,
            servants: 0,
            limits: Limits::default(),
        },
        revisions: vec![Revision {
            number: 1,
            image: "sha256:0".into(),
            published: 1,
            source: "--apt x".into(),
            current: true,
        }],
        nodes: vec![Node { name: node.clone(), argv: one_text("x") }],
        interface: Interface {
            topics: vec![Topic {
                name: name.clone(),
                type_name: type_name.clone(),
                md5: String::new(),
                direction: Direction::Input,
                latched: false,
                lazy: true,
                qos: Some(api::interface::Qos {
                    deadline: Some(0.5),
                    lifespan: Some(1.5),
                    lease: Some(2.5),
                    ..api::interface::Qos::default()
                }),
            }],
            services: vec![Service { name: name.clone(), type_name: type_name.clone(), node: node.clone() }],
            actions: vec![Action { name: name.clone(), type_name, node }],
            parameters: vec![Parameter {
                name: name.clone(),
                node: Some("/x".into()),
                value: Some(Value::from(1)),
                descriptor: Some(api::interface::Descriptor {
                    range: Some(api::interface::Range { from: Some(0.5), to: Some(1.5), step: Some(0.5) }),
                    ..api::interface::Descriptor::default()
                }),
            }],
            lifecycle: one_text("/n"),
            needs: vec![Need { name: name.clone(), nodes: one_text("/n") }],
            requests: vec![api::interface::Request {
                node: "/n".into(),
                input: name.clone(),
                outputs: vec![name],
                by: "stamp".into(),
                reason: "watched".into(),
            }],
        },
        shared: Some(api::Shared::default()),
        groups: vec![api::Group {
            revision: 1,
            robots: 2,
            servants: vec![api::GroupServant { id: "x-1".into(), ready: true, retiring: false, under_way: 1 }],
            waiting: 0,
            answered: 1,
            failed: 0,
            asked_again: 0,
            wasted: 0,
            mean_ms: Some(1.5),
        }],
        rollout: true,
    }
}

fn options() -> PushOptions {
    let names = || [("a".to_owned(), "b".to_owned())].into();
    PushOptions {
        name: some_text("x"),
        apt: some_text("x"),
        base: some_text("noetic"),
        launch: some_text("x.launch"),
        nodes: one_text("x"),
        params: [("k".to_owned(), Value::from(1))].into(),
        args: names(),
        remaps: names(),
        interface: some_text(""),
        map: names(),
        with: one_text("x"),
        packages_up_to: one_text("x"),
        packages_skip: one_text("x"),
        cmake_args: one_text("-DX=1"),
        on: one_text("maps"),
        as_underlay: some_text("x"),
        limits: limits(),
        caps: Caps { cpus: Some(2.0), memory: Some(Size(1 << 30)) },
        sla: Sla { rrt: Span::from_millis(100), max_rrt: Span::from_millis(300), ..Sla::default() },
        grants: Grants {
            devices: one_text("nvidia.com/gpu=0"),
            volumes: vec![Volume { source: "/a".into(), target: "/b".into() }],
            egress: one_text("example.org:80"),
        },
        requests: vec!["/a=/b".into()],
        stateful: true,
        stateless: true,
        shared: Some(api::Shared::default()),
        rollout: Some(rollout_terms()),
        created: Some(1),
        source: "--apt x".into(),
    }
}

fn underlay() -> Underlay {
    Underlay {
        name: "maps".into(),
        revision: 2,
        base: "bookworm-ros1".into(),
        ros: 1,
        distribution: "noetic".into(),
        packages: one_text("map_tools"),
        bytes: Size(1 << 20),
        published: 1,
        source: "~/lab_ws".into(),
        services: vec![StandingService { service: "nav".into(), on: 1 }],
    }
}

fn base() -> BaseDetail {
    let versions = || [("a".to_owned(), "1.0".to_owned())].into();
    BaseDetail {
        summary: BaseSummary {
            name: "x".into(),
            summary: "x".into(),
            ros: 1,
            distribution: "noetic".into(),
            system: "debian bookworm".into(),
            state: BaseState::Ready,
            toolchain: true,
            bytes: Size(1),
        },
        includes: one_text("x"),
        ros_packages: versions(),
        python_packages: versions(),
        debian_packages: versions(),
        findings: vec![finding()],
    }
}

fn finding() -> BaseFinding {
    BaseFinding { subject: "x".into(), found: "x".into(), consequence: "x".into() }
}

fn problem() -> Problem {
    Problem {
        kind: "urn:cloudroid:unknown-service".into(),
        title: "unknown service".into(),
        status: 404,
        detail: "there is none".into(),
        next: some_text("push it"),
        exists: one_text("x"),
        retry_after: Some(1),
        log: one_text("x"),
    }
}

fn explanation() -> Explanation {
    let link = Link {
        round_trip: Some(1.5),
        clock: Some(0.5),
        throughput: Some(1e6),
        drops: one_text("x"),
        desire: Some(1.5),
        max: Some(1.5),
        threshold: Some(0.5),
        frames_per_second: Some(1.5),
        desired_frames_per_second: Some(1.5),
        age: Some(1.5),
        desired_age: Some(1.5),
        fallback_after: Some(1.5),
        satisfaction: Some(0.5),
        phases: vec![Part::default()],
        late_in: Some(Part::default()),
        trace: some_text("4bf92f3577b34da6a3ce929d0e0e4736"),
        ..Link::default()
    };
    Explanation {
        robot: "r1".into(),
        causes: vec![Cause { weight: Weight::Slows, what: "it is slow".into(), next: "wait".into() }],
        servants: vec![Served { servant: servant(), throttled: 0.5, cores: 1.5, links: vec![link, Link::default()] }],
        events: vec![event()],
    }
}

fn status() -> Status {
    Status {
        version: "0.1.0".into(),
        architecture: "x86_64".into(),
        pid: 1,
        home: "/h".into(),
        listen: "127.0.0.1:9090".into(),
        certificate: some_text("x"),
        default_service: some_text("x"),
        started: 1,
        isolation: Isolation::default(),
        capacity: Capacity::default(),
        limits: limits(),
        services: 1,
        servants: 1,
        warm_pool: 1,
        warm_nodes: 1,
        connections: 1,
        usage: usage(),
        black_box: 10.5,
        warnings: one_text("x"),
    }
}

fn update() -> Update {
    Update {
        time: 1,
        machine: Some(Arc::new(Machine {
            status: status(),
            cores: 0.5,
            host_cores: 4,
            host_memory: Some(1),
            host_memory_available: Some(50.0),
        })),
        services: vec![Arc::new(detail().summary)],
        services_gone: one_text("adder"),
        servants: explanation().servants.into_iter().map(Arc::new).collect(),
        servants_gone: one_text("s1"),
        back_offs: Some(vec![back_off()]),
        events: vec![Arc::new(event())],
    }
}

fn trial() -> Trial {
    Trial {
        service: "x".into(),
        inputs: vec![Fed { from: vec!["/recorded".into()], topic: "/x".into(), type_name: "p/T".into(), sent: 1 }],
        outputs: vec![Heard {
            topic: "/x".into(),
            type_name: "p/T".into(),
            received: 1,
            bytes: 1,
            last: Some(Value::from(1)),
        }],
        rrt: Some(Times { p50: 1.5, p90: 1.5, max: 1.5, desire: 1.5, acceptable: 1.5 }),
        ..Trial::default()
    }
}

fn calibration() -> Calibration {
    Calibration {
        service: "x".into(),
        inputs: trial().inputs,
        pace: Some(1.5),
        network: Some(TimeSpread::default()),
        points: vec![Point { compute: Some(TimeSpread::default()), ..Point::default() }],
        rows: vec![row()],
        ..Calibration::default()
    }
}

fn shadow() -> Shadow {
    Shadow {
        service: "x".into(),
        compared: vec![Compared {
            present: Some(TimeSpread::default()),
            candidate: Some(TimeSpread::default()),
            fields: vec![FieldDifference::default()],
            ..Compared::default()
        }],
        not_compared: vec![NotCompared::default()],
        ..Shadow::default()
    }
}

fn shadow_options() -> ShadowOptions {
    ShadowOptions {
        revision: 2,
        robot: some_text("r1"),
        requests: Some(40),
        ignore: vec!["x".into()],
        acting: true,
        ..ShadowOptions::default()
    }
}

fn calibration_options() -> CalibrationOptions {
    CalibrationOptions {
        source: Source::Live,
        robot: some_text("r1"),
        seconds: Some(1.5),
        bytes: Some(Size(1 << 20)),
        cpus: vec![0.5],
        requests: Some(40),
        rate: Some(1.5),
        fast: true,
        input: some_text("/x"),
        network: Some(1.5),
        aux: [("image".to_owned(), "640x480".to_owned())].into(),
        memory: Some(Size(1 << 30)),
        own: true,
        times: true,
        keep: Some(60.0),
    }
}

fn token() -> Token {
    let pattern = || vec!["det*".parse().expect("a pattern")];
    Token {
        name: "r1".into(),
        role: access::Role::Robot,
        services: pattern(),
        robot: some_text("r1"),
        classes: pattern(),
        created: 1,
        expires: Some(1),
        last_used: Some(1),
        revoked: Some(1),
    }
}

fn new_token() -> NewToken {
    NewToken {
        name: "r1".into(),
        role: access::Role::Robot,
        services: token().services,
        robot: some_text("r1"),
        classes: token().classes,
        lifetime: Some(1),
    }
}

fn new_rule() -> NewRule {
    NewRule {
        who: "role:robot".parse().expect("a role"),
        services: "*".parse().expect("a pattern"),
        allow: vec!["subscribe:/camera/**".parse().expect("a grant")],
    }
}

fn sample(name: &'static str, value: impl serde::Serialize) -> (&'static str, Value) {
    (name, serde_json::to_value(value).expect("plain data"))
}

/// Samples of every type of the document, as serialized by serde, with and without optional fields.
pub fn samples() -> Vec<(&'static str, Value)> {
    let fits = Fit {
        cpus: 1.5,
        memory: Size(1),
        free_cpus: 1.5,
        free_memory: Size(1),
        waiting: 1,
        stalled: some_text("it swaps"),
        never: some_text("x"),
        full: false,
        now: false,
        ends: one_text("x"),
        lacking_cpus: 1.5,
        lacking_memory: Size(1),
        costs: vec![Cost {
            servant: "x".into(),
            service: "x".into(),
            robot: "x".into(),
            cpus: 1.5,
            left: 0.5,
            rrt: Some(0.1),
            later: Some(0.2),
            accepts: Some(0.3),
        }],
        more: Some(1),
        beyond_cpus: 0.5,
        beyond_memory: Size(1),
        at_present_use: Some(UseForecast { unused_cpus: 1.5, cpus: Some(0.5), more: Some(3) }),
        expected: Some(Expected { rrt: 0.1, from: "x".into() }),
        shared: Some(1),
    };
    let bare = Fit {
        stalled: None,
        never: None,
        more: None,
        at_present_use: Some(UseForecast { unused_cpus: 1.5, cpus: None, more: None }),
        expected: None,
        shared: None,
        ..fits.clone()
    };
    let mut samples = vec![
        sample("ShadowOptions", shadow_options()),
        sample("ShadowOptions", ShadowOptions::default()),
        sample("CalibrationOptions", calibration_options()),
        sample("CalibrationOptions", CalibrationOptions::default()),
        sample("Fit", fits),
        sample("Fit", Fit { at_present_use: None, ..bare.clone() }),
        sample("Fit", bare),
        sample("NewRule", new_rule()),
        sample("NewToken", new_token()),
        sample(
            "NewToken",
            NewToken { services: Vec::new(), robot: None, classes: Vec::new(), lifetime: None, ..new_token() },
        ),
        sample("Rule", Rule { id: 1, who: new_rule().who, services: new_rule().services, allow: new_rule().allow }),
        sample(
            "Audited",
            Audited {
                id: 7,
                time: 1,
                who: "alice (deployer)".into(),
                from: "10.0.0.3:5000".into(),
                action: "deploy".into(),
                did: "begin a push".into(),
                object: "service adder".into(),
                status: 200,
                more: 3,
            },
        ),
        sample("Secret", Secret { token: token(), secret: "x".into() }),
        sample("Token", Token { robot: None, expires: None, last_used: None, revoked: None, ..token() }),
        sample(
            "Whoami",
            Whoami {
                name: "r1".into(),
                roles: vec![access::Role::Robot],
                services: token().services,
                robot: some_text("r1"),
                may: one_text("enter"),
            },
        ),
        sample("SignIn", SignIn { name: "alice".into(), password: "x".into() }),
        sample(
            "Session",
            Session {
                name: some_text("alice"),
                role: Some(access::Role::Viewer),
                csrf: some_text("x"),
                expires: Some(1),
                needed: true,
                accounts: true,
                loopback_robots: true,
                provider: Some(ProviderLink { name: "Lab".into(), path: "/x".into() }),
            },
        ),
        sample("Session", Session::default()),
        sample(
            "SessionLine",
            SessionLine {
                id: 1,
                name: "alice".into(),
                role: access::Role::Viewer,
                from: "127.0.0.1:1".into(),
                created: 1,
                last_used: 1,
                expires: 1,
            },
        ),
        sample(
            "NewAccount",
            NewAccount {
                name: "alice".into(),
                password: "x".into(),
                role: access::Role::Viewer,
                services: token().services,
            },
        ),
        sample(
            "AccountChange",
            AccountChange {
                password: some_text("x"),
                role: Some(access::Role::Viewer),
                services: token().services,
                disabled: Some(true),
            },
        ),
        sample("AccountChange", AccountChange::default()),
        sample(
            "Account",
            Account {
                name: "alice".into(),
                role: access::Role::Viewer,
                services: token().services,
                created: 1,
                last_login: Some(1),
                disabled: Some(1),
                sessions: 1,
            },
        ),
        sample("BackOff", back_off()),
        sample("StandingService", underlay().services.remove(0)),
        sample("Underlay", underlay()),
        sample("BaseDetail", base()),
        sample("BaseFinding", finding()),
        sample("BaseSummary", base().summary),
        sample("Clock", Clock { now: 1.5 }),
        sample("Event", event()),
        sample("Explained", explained_sla()),
        sample("Explained", Explained::default()),
        sample("NewRows", new_rows()),
        sample("NewRows", NewRows::default()),
        sample("Row", row()),
        sample("Explanation", explanation()),
        sample("Limits", Limits::default()),
        sample("Problem", problem()),
        sample("Problem", Problem::default()),
        sample("PushOptions", options()),
        sample("PushOptions", PushOptions::default()),
        sample("Rollback", Rollback { revision: Some(1) }),
        sample("Rollback", Rollback::default()),
        sample("Rollout", rollout()),
        sample("RolloutOrder", RolloutOrder::Promote),
        sample("RolloutOrder", RolloutOrder::Abort),
        sample("RolloutOrder", RolloutOrder::Start { revision: 1, terms: rollout_terms() }),
        sample("Servant", servant()),
        sample(
            "Differences",
            api::differences::Differences {
                service: "s".into(),
                from: 1,
                to: 2,
                differences: vec![api::differences::Difference {
                    part: api::differences::RevisionPart::Push,
                    name: "package".into(),
                    before: some_text("a"),
                    after: some_text("b"),
                }],
            },
        ),
        sample("ServantHistory", history()),
        sample(
            "MachineHistory",
            api::history::MachineHistory { step: 60, figures: api::history::MachineFigures::default() },
        ),
        sample("ServiceDetail", detail()),
        sample("Status", status()),
        sample("Update", update()),
        sample("Update", Update::default()),
        sample("Stopped", Stopped { stopped: one_text("x") }),
        sample("Trial", trial()),
        sample("Trial", Trial::default()),
    ];
    let check = |status, fix| Check { name: "cgroups".into(), status, found: "none".into(), fix };
    let checks = vec![check(CheckStatus::Missing, some_text("mount them")), check(CheckStatus::Ok, None)];
    samples.push(sample("Doctor", Doctor { checks }));
    let levels = [LogLevel::Debug, LogLevel::Info, LogLevel::Warn, LogLevel::Error, LogLevel::Fatal];
    for (stream, level) in [(Stream::Stdout, None)].into_iter().chain(levels.map(|level| (Stream::Stderr, Some(level))))
    {
        let line = LogLine { time: 1, node: "/n".into(), stream, level, line: "x".into() };
        samples.push(sample("LogLine", line));
    }
    for event in [
        CalibrationEvent::Step { title: "x".into() },
        CalibrationEvent::Measured { point: Point::default(), times: vec![1.5] },
        CalibrationEvent::Kept { servant: "x".into(), calibration: Box::default() },
        CalibrationEvent::Done { calibration: Box::new(calibration()) },
        CalibrationEvent::Done { calibration: Box::default() },
        CalibrationEvent::Error { problem: problem() },
    ] {
        samples.push(sample("CalibrationEvent", event));
    }
    for event in [
        ShadowEvent::Step { title: "x".into() },
        ShadowEvent::Done { shadow: Box::new(shadow()) },
        ShadowEvent::Done { shadow: Box::default() },
        ShadowEvent::Error { problem: problem() },
    ] {
        samples.push(sample("ShadowEvent", event));
    }
    for event in [
        PushEvent::Accepted { number: 1 },
        PushEvent::Step { title: "x".into(), last_took: Some(1) },
        PushEvent::step("x"),
        PushEvent::Log { line: "x".into() },
        PushEvent::Progress { unit: "bytes".into(), done: 1, total: Some(2) },
        PushEvent::Warning { message: "x".into() },
        PushEvent::Done {
            service: Box::new(detail()),
            layers: vec![Layer { name: "base".into(), digest: "sha256:0".into(), size: 1, cached: true }],
            took: 1,
            unchanged: true,
        },
        PushEvent::Underlay { underlay: Box::new(underlay()), layers: Vec::new(), took: 1, unchanged: true },
        PushEvent::Error { problem: problem() },
    ] {
        samples.push(sample("PushEvent", event));
    }
    samples.extend(machines::samples());
    samples.extend(observed::samples());
    samples.extend(pushes::samples());
    samples
}
