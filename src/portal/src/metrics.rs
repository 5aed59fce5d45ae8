//! `/metrics`: read by Prometheus and compatible collectors. docs/metrics.md lists the metrics; a story compares it
//! with the output.

mod exposition;
mod process;

use std::collections::BTreeMap;
use std::sync::Arc;

use api::Phase;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use bridge::MetricsSnapshot;

use crate::app::App;
use crate::errors::Error;
use choreographer::{Choreographer, Handle};
use exposition::{
    OPEN_METRICS, PROMETHEUS, accepts_open_metrics, format_labels, to_open_metrics, write_family, write_gauge,
};

const PHASES: [Phase; 6] =
    [Phase::Requested, Phase::Admitted, Phase::Created, Phase::Starting, Phase::Ready, Phase::Draining];

/// Responds with all metrics, as OpenMetrics if that is requested.
pub async fn metrics(State(app): State<Arc<App>>, headers: HeaderMap) -> Result<Response, Error> {
    let mut out = String::new();
    let services = app.state.service_names()?;
    write_gauge(&mut out, "cloudroid_services", "Published services.", [(String::new(), services.len() as f64)]);
    write_servant_metrics(&mut out, &app.choreographer);
    write_group_metrics(&mut out, &app.choreographer, &services);
    let (pushes, failed) = app.pusher.counts();
    write_family(
        &mut out,
        "cloudroid_pushes_total",
        "counter",
        "Pushes since the daemon started.",
        [
            (format_labels(&[("result", "published")]), pushes as f64),
            (format_labels(&[("result", "failed")]), failed as f64),
        ],
    );
    let (unknown, slowed) = app.principals.token_counts();
    write_family(
        &mut out,
        "cloudroid_refused_tokens_total",
        "counter",
        "Tokens that let nobody in: unknown ones, and those not looked at because too many came from their address.",
        [(format_labels(&[("why", "unknown")]), unknown as f64), (format_labels(&[("why", "slowed")]), slowed as f64)],
    );
    let (wrong, slowed) = app.principals.password_counts();
    write_family(
        &mut out,
        "cloudroid_refused_passwords_total",
        "counter",
        "Passwords that let nobody in: wrong ones, and those not looked at because too many came for their account.",
        [(format_labels(&[("why", "wrong")]), wrong as f64), (format_labels(&[("why", "slowed")]), slowed as f64)],
    );
    write_gauge(
        &mut out,
        "cloudroid_strangers",
        "Unauthenticated TCP connections.",
        [(String::new(), app.strangers.count() as f64)],
    );
    write_family(
        &mut out,
        "cloudroid_dropped_strangers_total",
        "counter",
        "Unauthenticated TCP connections that were closed because newer ones needed their places.",
        [(String::new(), app.strangers.dropped_count() as f64)],
    );
    if let Some(end) = app.tls.as_ref().and_then(|tls| tls.expiry()) {
        write_gauge(
            &mut out,
            "cloudroid_certificate_end_seconds",
            "When the portal's certificate ends, in seconds since 1970.",
            [(String::new(), end as f64 / 1000.0)],
        );
    }
    write_capacity_metrics(&mut out, &app.choreographer);
    let memory = app.choreographer.memory().whole();
    write_gauge(
        &mut out,
        "cloudroid_memory_bytes",
        "Bytes held for clients and servants, and how many may be.",
        [
            (format_labels(&[("what", "held")]), memory.used_bytes() as f64),
            (format_labels(&[("what", "limit")]), memory.limit() as f64),
        ],
    );
    write_family(
        &mut out,
        "cloudroid_memory_refused_total",
        "counter",
        "How often a client or servant was refused memory.",
        [(String::new(), app.choreographer.memory().refusal_count() as f64)],
    );
    if let Some(tracer) = app.choreographer.tracer() {
        write_family(
            &mut out,
            "cloudroid_dropped_spans_total",
            "counter",
            "Spans that were dropped because the OpenTelemetry collector did not take them in time.",
            [(String::new(), tracer.dropped_spans() as f64)],
        );
    }
    let exists = |name: &str| services.iter().any(|service| service == name);
    app.choreographer.request_times().write_prometheus(&mut out, exists);
    let servants = app.choreographer.servants();
    write_usage_metrics(&mut out, &servants).await;
    let memory = app.choreographer.memory();
    let work = servants.iter().map(|handle| (servant_labels(handle), memory.servant(&handle.id).work_time()));
    write_family(
        &mut out,
        "cloudroid_servant_daemon_seconds_total",
        "counter",
        "The daemon's processor time for a servant.",
        work.map(|(labels, time)| (labels, time.as_secs_f64())),
    );
    process::write_process_metrics(&mut out);
    let (kind, text) =
        if accepts_open_metrics(&headers) { (OPEN_METRICS, to_open_metrics(&out)) } else { (PROMETHEUS, out) };
    Ok(([(header::CONTENT_TYPE, kind)], text).into_response())
}

/// Writes the metrics of groups of robots that share servants.
fn write_group_metrics(out: &mut String, choreographer: &Choreographer, services: &[String]) {
    let (mut requests, mut waiting, mut ready) = (Vec::new(), Vec::new(), Vec::new());
    for service in services {
        for group in choreographer.groups(service) {
            let revision = group.revision.to_string();
            let of = [("service", service.as_str()), ("revision", &revision)];
            for (outcome, count) in [
                ("answered", group.answered),
                ("failed", group.failed),
                ("asked_again", group.asked_again),
                ("wasted", group.wasted),
            ] {
                let of = format_labels(&[of[0], of[1], ("outcome", outcome)]);
                requests.push((of, count as f64));
            }
            waiting.push((format_labels(&of), group.waiting as f64));
            let count = group.servants.iter().filter(|one| one.ready).count();
            ready.push((format_labels(&of), count as f64));
        }
    }
    write_family(
        out,
        "cloudroid_shared_requests_total",
        "counter",
        "Requests to servants that robots share, by what became of them; wasted: work of replicas that nobody needed.",
        requests,
    );
    write_gauge(out, "cloudroid_shared_waiting", "Requests that wait for a servant that robots share.", waiting);
    write_gauge(out, "cloudroid_shared_servants", "Servants that robots share and that answer.", ready);
}

fn write_servant_metrics(out: &mut String, choreographer: &Choreographer) {
    let handles = choreographer.servants();
    let count = |phase| handles.iter().filter(|handle| handle.life().phase == phase).count();
    let by_phase = PHASES.map(|phase| (format_labels(&[("phase", &phase.to_string())]), count(phase) as f64));
    write_gauge(out, "cloudroid_servants", "Servants by state.", by_phase);
    write_gauge(
        out,
        "cloudroid_warm_pool",
        "Containers made ahead.",
        [(String::new(), choreographer.warm_pool().0 as f64)],
    );
    let mut connections: BTreeMap<String, usize> = BTreeMap::new();
    for handle in &handles {
        *connections.entry(handle.service().to_owned()).or_default() += handle.connections();
    }
    let connections =
        connections.into_iter().map(|(service, count)| (format_labels(&[("service", &service)]), count as f64));
    write_gauge(out, "cloudroid_connections", "Connections of robots.", connections);
    let metrics = |handle: &Arc<Handle>| Some((servant_labels(handle), handle.reach()?.metrics()));
    let bridges: Vec<_> = handles.iter().filter_map(metrics).collect();
    let messages = bridges.iter().flat_map(|(of, metrics)| {
        [
            (format!("{of},direction=\"in\""), metrics.frames_in as f64),
            (format!("{of},direction=\"out\""), metrics.frames_out as f64),
        ]
    });
    write_family(out, "cloudroid_messages_total", "counter", "WebSocket messages of robots.", messages);
    let dropped = bridges.iter().map(|(of, metrics)| (of.clone(), metrics.dropped_count() as f64));
    write_family(out, "cloudroid_dropped_total", "counter", "Messages dropped because someone was slow.", dropped);
    // All rows of a counter must be adjacent.
    let told: Vec<_> = bridges.iter().map(|(of, metrics)| (of, metrics.all())).collect();
    for (at, (name, help, _)) in MetricsSnapshot::default().all().into_iter().enumerate() {
        let rows = told.iter().map(|(of, all)| ((*of).clone(), all[at].2 as f64));
        write_family(out, name, "counter", help, rows);
    }
}

fn write_capacity_metrics(out: &mut String, choreographer: &Choreographer) {
    let (capacity, taken, waiting) = choreographer.admission().snapshot();
    let rows = [
        ("cloudroid_capacity_cpus", "Cores that may be reserved.", capacity.cpus()),
        ("cloudroid_capacity_memory_bytes", "Memory that may be reserved.", capacity.memory as f64),
        ("cloudroid_promised_cpus", "Cores reserved.", taken.cpus()),
        ("cloudroid_promised_memory_bytes", "Memory reserved.", taken.memory as f64),
        ("cloudroid_waiting", "Robots that wait for capacity.", waiting as f64),
    ];
    for (name, help, value) in rows {
        write_gauge(out, name, help, [(String::new(), value)]);
    }
    let stalled = choreographer.admission().stall_reason().is_some();
    write_gauge(
        out,
        "cloudroid_stalled",
        "1 while nobody is admitted since the machine stalls.",
        [(String::new(), f64::from(u8::from(stalled)))],
    );
    write_family(
        out,
        "cloudroid_moves_total",
        "counter",
        "How often the controller changed cpu.max or cpu.weight of a servant.",
        [(String::new(), choreographer.move_count() as f64)],
    );
}

async fn write_usage_metrics(out: &mut String, handles: &[Arc<Handle>]) {
    let mut rows = Vec::new();
    for handle in handles {
        if let Some(usage) = choreographer::usage(handle).await {
            rows.push((servant_labels(handle), usage));
        }
    }
    let of = |value: fn(&api::Usage) -> f64| rows.iter().map(move |(labels, usage)| (labels.clone(), value(usage)));
    write_gauge(out, "cloudroid_servant_memory_bytes", "Memory of a servant.", of(|usage| usage.memory as f64));
    write_gauge(out, "cloudroid_servant_pids", "Processes and threads of a servant.", of(|usage| usage.pids as f64));
    let cpu = of(|usage| usage.cpu_usec as f64 / 1e6);
    write_family(out, "cloudroid_servant_cpu_seconds_total", "counter", "Processor time of a servant.", cpu);
    let throttled = of(|usage| usage.throttled_usec as f64 / 1e6);
    write_family(
        out,
        "cloudroid_servant_throttled_seconds_total",
        "counter",
        "Time in which a servant had used its cores up.",
        throttled,
    );
    write_pressure_metrics(out, &rows);
    let kills = of(|usage| usage.oom_kills as f64);
    write_family(out, "cloudroid_servant_oom_kills_total", "counter", "Processes killed at the memory limit.", kills);
}

/// Writes the pressure metrics, which cgroup v1 does not have.
fn write_pressure_metrics(out: &mut String, rows: &[(String, api::Usage)]) {
    let waits = rows.iter().flat_map(|(labels, usage)| {
        let each =
            usage.pressure.map(|pressure| [("cpu", pressure.cpu), ("memory", pressure.memory), ("io", pressure.io)]);
        each.into_iter()
            .flatten()
            .map(move |(what, percent)| (format!("{labels},resource=\"{what}\""), percent / 100.0))
    });
    write_gauge(
        out,
        "cloudroid_servant_pressure_ratio",
        "Share of the last ten seconds in which some of a servant waited.",
        waits,
    );
}

fn servant_labels(handle: &Handle) -> String {
    format_labels(&[("servant", &handle.id), ("service", handle.service()), ("robot", &handle.robot)])
}
