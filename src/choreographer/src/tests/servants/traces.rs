//! Tests of what a tracer is given.

use link::control::RequestTiming;
use reach::links::{MeasuredRequest, RequestUpdate};

use super::*;

/// Remembers what it is given as text.
#[derive(Debug, Default)]
struct RememberingTracer(Mutex<Vec<String>>);

impl RequestTracer for RememberingTracer {
    fn record(&self, servant: TracedServant<'_>, request: &MeasuredRequest<'_>) {
        let TracedServant { service, servant, robot } = servant;
        let id = request.timing.id;
        let text = format!("{robot:?} {service} {servant} {} {id}", request.session);
        self.0.lock().push(text);
    }
    fn trace_id(&self, _: &str, _: u64) -> Option<String> {
        None
    }
    fn dropped_spans(&self) -> u64 {
        0
    }
}

#[tokio::test(start_paused = true)]
async fn a_measured_request_is_traced_with_its_servant_and_robot() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let tracer = Arc::new(RememberingTracer::default());
    let daemon = world.daemon_with(|options| options.tracer = Some(Arc::clone(&tracer) as _));
    let lease = ready(&daemon, ServantRequest::new("greet", "r2d2")).await;
    let observer = rollouts::observer_of(&daemon, &lease);
    let timing = RequestTiming { id: 7, total: Some(5.0), ..RequestTiming::default() };
    let request = MeasuredRequest {
        session: "run-1",
        node: "/greeter",
        max: None,
        timing: &timing,
        update: RequestUpdate::Answered,
    };
    observer.on_request_measured(Some("r2d2"), &request);
    let expected = format!("Some(\"r2d2\") greet {} run-1 7", lease.handle().id);
    assert_eq!(*tracer.0.lock(), [expected]);
    assert!(daemon.tracer().is_some());
}
