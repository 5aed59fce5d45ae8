//! Traces of robots' requests, sent to an OpenTelemetry collector by OTLP/HTTP. Stubs report how long each request took
//! and in which phases; of each report that is sampled, this makes one trace. Nothing is measured for it.
//!
//! ```text
//!   stub ── report, once a second ─▶ link ─▶ choreographer ─▶ record ─▶ bounded queue ─▶ export ─▶ collector
//!
//!   request    ├────────────────────────────────────┤     ends when the report arrives
//!   serialise  ├──┤
//!   up            ├─────┤
//!   queue               ├────┤
//!   compute                  ├─────────────┤
//!   down                                   ├────────┤
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use anyhow::Context;
use async_trait::async_trait;
use bytes::Bytes;
use choreographer::{RequestTracer, TracedServant};
use http_body_util::Full;
use hyper::{Request, Response};
use opentelemetry::trace::{SpanContext, SpanId, SpanKind, Status, TraceFlags, TraceId, TraceState};
use opentelemetry::{InstrumentationScope, KeyValue};
use opentelemetry_http::{HttpClient, HttpError};
use opentelemetry_otlp::{Protocol, WithExportConfig, WithHttpConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{
    Sampler, SamplingDecision, ShouldSample, SpanData, SpanEvents, SpanExporter, SpanLinks,
};
use outbound::OutboundClient;
use reach::links::{MeasuredRequest, RequestUpdate};
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

use crate::config::TelemetryConfig;

/// Maximum number of traces that wait for the collector.
const QUEUE: usize = 2048;
/// Maximum number of traces of one request to the collector.
const BATCH: usize = 512;
/// Interval in which traces are gathered.
const BATCH_INTERVAL: Duration = Duration::from_secs(1);
/// Timeout of a request to the collector, and of all attempts to send one batch.
const TIME: Duration = Duration::from_secs(10);
/// Limit on the collector's answer in bytes.
const ANSWER: usize = 64 << 10;
/// Longest time in milliseconds that a robot is believed: a day.
const LONGEST: f64 = 86_400e3;
/// Maximum number of characters of a robot's text in an attribute.
const MAX_ATTRIBUTE_LENGTH: usize = 200;

/// Starts exporting traces to the collector of the configuration. Must be called within a runtime of threads without
/// privileges: the collector's answers are read there.
pub fn start(config: &TelemetryConfig) -> anyhow::Result<Arc<dyn RequestTracer>> {
    let authorities = config.authorities.clone();
    let advice = "install the package ca-certificates, or name a file: authorities of [telemetry]";
    let client = CollectorClient {
        outbound: OutboundClient::new(authorities, advice).with_limits(TIME, ANSWER),
        is_failing: AtomicBool::new(false),
    };
    let mut exporter = opentelemetry_otlp::SpanExporter::builder()
        .with_http()
        .with_http_client(client)
        .with_endpoint(config.traces_url()?.to_string())
        .with_protocol(Protocol::HttpBinary)
        .with_timeout(TIME)
        .build()
        .context("cannot export traces")?;
    let resource = Resource::builder()
        .with_service_name("cloudroidd")
        .with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")))
        .build();
    exporter.set_resource(&resource);
    Ok(Arc::new(SpanQueue::start(exporter, config.sampling_ratio)))
}

/// Makes the spans of requests, and queues them for the exporter.
#[derive(Debug)]
struct SpanQueue {
    sampler: Sampler,
    /// The spans of one request each.
    traces: mpsc::Sender<Vec<SpanData>>,
    dropped: Arc<AtomicU64>,
}

impl SpanQueue {
    fn start(exporter: impl SpanExporter + 'static, sampling_ratio: f64) -> SpanQueue {
        let (traces, queued) = mpsc::channel(QUEUE);
        let dropped = Arc::new(AtomicU64::new(0));
        tokio::spawn(export(exporter, queued, Arc::clone(&dropped)));
        SpanQueue { sampler: Sampler::TraceIdRatioBased(sampling_ratio), traces, dropped }
    }

    fn is_sampled(&self, trace: TraceId) -> bool {
        let kind = SpanKind::Server;
        let result = self.sampler.should_sample(None, trace, "request", &kind, &[], &[]);
        result.decision == SamplingDecision::RecordAndSample
    }
}

impl RequestTracer for SpanQueue {
    fn record(&self, servant: TracedServant<'_>, request: &MeasuredRequest<'_>) {
        let ids = RequestIds::derive(request.session, request.timing.id);
        if !self.is_sampled(ids.trace) {
            return;
        }
        let spans = make_spans(servant, request, &ids, SystemTime::now());
        let count = spans.len() as u64;
        if self.traces.try_send(spans).is_err() {
            self.dropped.fetch_add(count, Ordering::Relaxed);
        }
    }

    fn trace_id(&self, session: &str, request: u64) -> Option<String> {
        let trace = RequestIds::derive(session, request).trace;
        self.is_sampled(trace).then(|| trace.to_string())
    }

    fn dropped_spans(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// Sends queued traces in batches until the queue is closed; counts the spans that the collector did not take.
async fn export(exporter: impl SpanExporter, mut queued: mpsc::Receiver<Vec<SpanData>>, dropped: Arc<AtomicU64>) {
    let mut traces = Vec::new();
    while queued.recv_many(&mut traces, BATCH).await > 0 {
        let batch: Vec<SpanData> = traces.drain(..).flatten().collect();
        let count = batch.len() as u64;
        // The client has logged why.
        if exporter.export(batch).await.is_err() {
            dropped.fetch_add(count, Ordering::Relaxed);
        }
        if queued.len() < BATCH {
            tokio::time::sleep(BATCH_INTERVAL).await;
        }
    }
}

/// Ids of a request's spans. They follow from session and request, so that nothing has to be stored to name them.
struct RequestIds {
    trace: TraceId,
    root: u64,
}

impl RequestIds {
    fn derive(session: &str, request: u64) -> RequestIds {
        let digest = Sha256::new().chain_update(session).chain_update(request.to_be_bytes()).finalize();
        let mut trace = [0; 16];
        trace.copy_from_slice(&digest[..16]);
        let mut root = [0; 8];
        root.copy_from_slice(&digest[16..24]);
        RequestIds { trace: TraceId::from_bytes(trace), root: u64::from_be_bytes(root) }
    }

    /// Returns the id of the span at `position`: the root is at 0, the phases follow.
    fn span(&self, position: u64) -> SpanId {
        // An id of zero is invalid.
        SpanId::from(self.root.wrapping_add(position).max(1))
    }
}

/// Returns the spans of a request that was reported at `now`. Start and end are computed back from there, because
/// robots report durations only.
///
/// A late request is reported when its T_max has passed, and again if it is answered after all: then its phases are
/// added to the root span that was sent before.
fn make_spans(
    servant: TracedServant<'_>,
    request: &MeasuredRequest<'_>,
    ids: &RequestIds,
    now: SystemTime,
) -> Vec<SpanData> {
    let timing = request.timing;
    let total = to_duration(timing.total.or(request.max).unwrap_or(0.0));
    let start = now.checked_sub(total).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut spans = Vec::new();
    if request.update != RequestUpdate::AnsweredLate {
        let root = SpanData {
            span_kind: SpanKind::Server,
            attributes: describe(servant, request),
            status: match request.update {
                RequestUpdate::Late => Status::error("the cloud did not answer in time"),
                RequestUpdate::Answered | RequestUpdate::AnsweredLate => Status::Unset,
            },
            ..make_span("request", (ids, 0), start, start + total)
        };
        spans.push(root);
    }
    let phases = [
        ("serialise", timing.serialise),
        ("up", timing.up),
        ("queue", timing.queue),
        ("compute", timing.compute),
        ("down", timing.down),
    ];
    // They are unknown for some answers.
    if timing.total.is_some() && phases.iter().any(|(_, time)| *time > 0.0) {
        let mut begun = start;
        for ((name, time), position) in phases.into_iter().zip(1..) {
            let end = begun + to_duration(time);
            spans.push(SpanData { parent_span_id: ids.span(0), ..make_span(name, (ids, position), begun, end) });
            begun = end;
        }
    }
    spans
}

/// Returns a span without parent and attributes.
fn make_span(
    name: &'static str,
    (ids, position): (&RequestIds, u64),
    start_time: SystemTime,
    end_time: SystemTime,
) -> SpanData {
    let (trace, span) = (ids.trace, ids.span(position));
    SpanData {
        span_context: SpanContext::new(trace, span, TraceFlags::SAMPLED, false, TraceState::default()),
        parent_span_id: SpanId::INVALID,
        parent_span_is_remote: false,
        span_kind: SpanKind::Internal,
        name: name.into(),
        start_time,
        end_time,
        attributes: Vec::new(),
        dropped_attributes_count: 0,
        events: SpanEvents::default(),
        links: SpanLinks::default(),
        status: Status::Unset,
        instrumentation_scope: InstrumentationScope::builder("cloudroid.request").build(),
    }
}

/// Returns the attributes of a request's root span.
fn describe(servant: TracedServant<'_>, request: &MeasuredRequest<'_>) -> Vec<KeyValue> {
    let text = |key: &'static str, value: &str| {
        let value: String = value.chars().take(MAX_ATTRIBUTE_LENGTH).collect();
        KeyValue::new(key, value)
    };
    let timing = request.timing;
    let mut all = vec![
        text("cloudroid.service", servant.service),
        text("cloudroid.servant", servant.servant),
        text("cloudroid.node", request.node),
        text("cloudroid.request", &timing.name),
        KeyValue::new("cloudroid.satisfaction", timing.satisfaction),
        KeyValue::new("cloudroid.local", timing.local),
        KeyValue::new("cloudroid.late", request.is_late()),
    ];
    all.extend(servant.robot.map(|robot| text("cloudroid.robot", robot)));
    all
}

/// Converts milliseconds that a robot reports; robots are not trusted.
fn to_duration(milliseconds: f64) -> Duration {
    Duration::try_from_secs_f64(milliseconds.clamp(0.0, LONGEST) / 1e3).unwrap_or_default()
}

/// Sends the exporter's requests by the daemon's own client, and logs when the collector fails and works again.
#[derive(Debug)]
struct CollectorClient {
    outbound: OutboundClient,
    is_failing: AtomicBool,
}

impl CollectorClient {
    /// Notes the outcome of a request, with the reason if it failed.
    fn note_outcome(&self, failure: Option<String>) {
        let was_failing = self.is_failing.swap(failure.is_some(), Ordering::Relaxed);
        match failure {
            Some(reason) if !was_failing => {
                tracing::warn!("traces cannot be exported and are dropped: {reason}; see endpoint of [telemetry]")
            }
            None if was_failing => tracing::info!("traces are exported again"),
            _ => {}
        }
    }
}

#[async_trait]
impl HttpClient for CollectorClient {
    async fn send_bytes(&self, request: Request<Bytes>) -> Result<Response<Bytes>, HttpError> {
        let sent = self.outbound.send(request.map(Full::new)).await;
        let failure = match &sent {
            Ok(answer) if answer.status().is_success() => None,
            Ok(answer) => Some(format!("the collector answered {}", answer.status())),
            Err(error) => Some(error.to_string()),
        };
        self.note_outcome(failure);
        sent.map_err(HttpError::from)
    }
}

#[cfg(test)]
mod tests {
    use axum::Router;
    use axum::http::{HeaderMap, StatusCode};
    use axum::routing::post;
    use link::control::RequestTiming;
    use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
    use opentelemetry_proto::tonic::common::v1::any_value::Value;
    use opentelemetry_sdk::trace::InMemorySpanExporter;
    use prost::Message;

    use super::*;

    const SERVANT: TracedServant<'static> =
        TracedServant { service: "faces", servant: "faces-4kq2", robot: Some("r2d2") };

    fn answered_timing() -> RequestTiming {
        RequestTiming {
            id: 7,
            name: "/image".to_owned(),
            total: Some(100.0),
            serialise: 5.0,
            up: 20.0,
            queue: 10.0,
            compute: 60.0,
            down: 5.0,
            local: false,
            satisfaction: 6.5,
        }
    }

    fn measured_request(timing: &RequestTiming, update: RequestUpdate) -> MeasuredRequest<'_> {
        MeasuredRequest { session: "run-1", node: "/detector", max: Some(80.0), timing, update }
    }

    fn spans_of(timing: &RequestTiming, update: RequestUpdate, now: SystemTime) -> Vec<SpanData> {
        let ids = RequestIds::derive("run-1", timing.id);
        make_spans(SERVANT, &measured_request(timing, update), &ids, now)
    }

    fn attribute(span: &SpanData, key: &str) -> Option<String> {
        let found = span.attributes.iter().find(|one| one.key.as_str() == key);
        found.map(|one| one.value.to_string())
    }

    #[test]
    fn ids_follow_from_session_and_request() {
        let ids = RequestIds::derive("run-1", 7);
        let again = RequestIds::derive("run-1", 7);
        assert_eq!((ids.trace, ids.root), (again.trace, again.root));
        for (session, request) in [("run-1", 8), ("run-2", 7)] {
            assert_ne!(ids.trace, RequestIds::derive(session, request).trace);
        }
        let last = RequestIds { root: u64::MAX, ..ids };
        assert_ne!(last.span(1), SpanId::INVALID);
    }

    #[test]
    fn phases_follow_each_other_within_the_request() {
        let now = SystemTime::now();
        let ms = Duration::from_millis;
        let spans = spans_of(&answered_timing(), RequestUpdate::Answered, now);
        let times: Vec<(&str, Duration, Duration)> = spans
            .iter()
            .map(|span| {
                let ago = |time| now.duration_since(time).expect("not later");
                (&*span.name, ago(span.start_time), ago(span.end_time))
            })
            .collect();
        assert_eq!(
            times,
            [
                ("request", ms(100), ms(0)),
                ("serialise", ms(100), ms(95)),
                ("up", ms(95), ms(75)),
                ("queue", ms(75), ms(65)),
                ("compute", ms(65), ms(5)),
                ("down", ms(5), ms(0)),
            ]
        );
        let root = &spans[0];
        assert_eq!(root.parent_span_id, SpanId::INVALID);
        for phase in &spans[1..] {
            assert_eq!(phase.parent_span_id, root.span_context.span_id());
            assert_eq!(phase.span_context.trace_id(), root.span_context.trace_id());
        }
        for (key, value) in [
            ("cloudroid.robot", "r2d2"),
            ("cloudroid.service", "faces"),
            ("cloudroid.servant", "faces-4kq2"),
            ("cloudroid.node", "/detector"),
            ("cloudroid.request", "/image"),
            ("cloudroid.satisfaction", "6.5"),
            ("cloudroid.local", "false"),
            ("cloudroid.late", "true"),
        ] {
            assert_eq!(attribute(root, key).as_deref(), Some(value), "{key}");
        }
    }

    #[test]
    fn an_answer_after_t_max_adds_its_phases_to_the_trace() {
        let now = SystemTime::now();
        let unanswered = RequestTiming { id: 7, ..RequestTiming::default() };
        let late = spans_of(&unanswered, RequestUpdate::Late, now);
        assert_eq!(late.len(), 1, "{late:?}");
        assert!(matches!(late[0].status, Status::Error { .. }));
        let took = now.duration_since(late[0].start_time).expect("before");
        assert_eq!(took, Duration::from_millis(80), "T_max");
        let added = spans_of(&answered_timing(), RequestUpdate::AnsweredLate, now);
        assert_eq!(added.len(), 5, "{added:?}");
        for phase in &added {
            assert_eq!(phase.parent_span_id, late[0].span_context.span_id());
        }
    }

    #[test]
    fn times_of_robots_are_not_trusted() {
        let now = SystemTime::now();
        for time in [f64::NAN, f64::INFINITY, -1.0, 1e300] {
            let timing = RequestTiming {
                total: Some(time),
                up: time,
                compute: 1.0,
                name: "x".repeat(10_000),
                ..answered_timing()
            };
            let spans = spans_of(&timing, RequestUpdate::Answered, now);
            assert_eq!(spans.len(), 6);
            for span in &spans {
                assert!(span.start_time <= span.end_time, "{time}: {span:?}");
            }
            let name = attribute(&spans[0], "cloudroid.request");
            assert_eq!(name.map(|name| name.len()), Some(MAX_ATTRIBUTE_LENGTH));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn sampled_requests_are_exported_and_the_others_have_no_trace() {
        let exporter = InMemorySpanExporter::default();
        let queue = SpanQueue::start(exporter.clone(), 0.5);
        let mut traces: Vec<String> = Vec::new();
        for id in 0..100 {
            let timing = RequestTiming { id, ..answered_timing() };
            queue.record(SERVANT, &measured_request(&timing, RequestUpdate::Answered));
            traces.extend(queue.trace_id("run-1", id));
        }
        assert!((20..80).contains(&traces.len()), "{}", traces.len());
        tokio::time::sleep(BATCH_INTERVAL * 3).await;
        let spans = exporter.get_finished_spans().expect("spans");
        let roots = spans.iter().filter(|span| span.name == "request");
        let exported: Vec<String> = roots.map(|span| span.span_context.trace_id().to_string()).collect();
        assert_eq!(exported, traces);
        assert_eq!(queue.dropped_spans(), 0);
    }

    #[tokio::test]
    async fn a_full_queue_drops_whole_traces_and_counts_their_spans() {
        let queue = SpanQueue::start(InMemorySpanExporter::default(), 1.0);
        let timing = answered_timing();
        // Nothing is taken from the queue meanwhile: this is the runtime's only thread.
        for _ in 0..QUEUE + 3 {
            queue.record(SERVANT, &measured_request(&timing, RequestUpdate::Answered));
        }
        assert_eq!(queue.dropped_spans(), 3 * 6);
    }

    /// Starts a collector that answers with this status. Returns its address and what it receives.
    async fn collector(status: StatusCode) -> (String, mpsc::Receiver<(HeaderMap, Bytes)>) {
        let (sender, received) = mpsc::channel(8);
        let take = move |headers: HeaderMap, body: Bytes| async move {
            sender.send((headers, body)).await.expect("the test waits");
            status
        };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await;
        let listener = listener.expect("a port");
        let address = listener.local_addr().expect("bound");
        let router = Router::new().route("/v1/traces", post(take));
        tokio::spawn(async move { axum::serve(listener, router).await });
        (format!("http://{address}"), received)
    }

    fn config(endpoint: String) -> TelemetryConfig {
        TelemetryConfig { endpoint, sampling_ratio: 1.0, authorities: None }
    }

    #[tokio::test]
    async fn a_collector_receives_the_trace_that_is_named() {
        let (endpoint, mut received) = collector(StatusCode::OK).await;
        let tracer = start(&config(endpoint)).expect("started");
        let timing = answered_timing();
        tracer.record(SERVANT, &measured_request(&timing, RequestUpdate::Answered));
        let (headers, body) = received.recv().await.expect("a request");
        assert_eq!(headers["content-type"], "application/x-protobuf");
        let request = ExportTraceServiceRequest::decode(body).expect("OTLP");
        let [resource] = request.resource_spans.as_slice() else {
            panic!("one resource: {request:?}");
        };
        let attributes = &resource.resource.as_ref().expect("a resource").attributes;
        let name = attributes.iter().find(|one| one.key == "service.name");
        let name = name.and_then(|one| one.value.as_ref()?.value.as_ref());
        assert_eq!(name, Some(&Value::StringValue("cloudroidd".to_owned())));
        let spans = &resource.scope_spans[0].spans;
        let names: Vec<&str> = spans.iter().map(|span| span.name.as_str()).collect();
        assert_eq!(names, ["request", "serialise", "up", "queue", "compute", "down"]);
        let trace: String = spans[0].trace_id.iter().map(|b| format!("{b:02x}")).collect();
        assert_eq!(tracer.trace_id("run-1", 7), Some(trace));
        let took = spans[0].end_time_unix_nano - spans[0].start_time_unix_nano;
        assert_eq!(took, 100_000_000);
        assert_eq!(tracer.dropped_spans(), 0);
    }

    #[tokio::test]
    async fn what_a_collector_refuses_is_counted() {
        let (endpoint, mut received) = collector(StatusCode::BAD_REQUEST).await;
        let tracer = start(&config(endpoint)).expect("started");
        let timing = answered_timing();
        tracer.record(SERVANT, &measured_request(&timing, RequestUpdate::Answered));
        received.recv().await.expect("a request");
        while tracer.dropped_spans() < 6 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}
