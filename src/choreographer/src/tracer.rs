//! Interface to the tracer of robots' requests, if the daemon has one.

use std::fmt;

use reach::links::MeasuredRequest;

/// The servant that a request went to.
#[derive(Debug, Clone, Copy)]
pub struct TracedServant<'a> {
    /// Name of the service.
    pub service: &'a str,
    /// Id of the servant; of a shared service, of the robot's place.
    pub servant: &'a str,
    /// Name of the robot, while the servant belongs to one.
    pub robot: Option<&'a str>,
}

/// Makes traces of the requests that stubs report. Never blocks: it is called where links are read.
pub trait RequestTracer: fmt::Debug + Send + Sync + 'static {
    /// Records a request, if its trace is sampled.
    fn record(&self, servant: TracedServant<'_>, request: &MeasuredRequest<'_>);
    /// Returns the id of a request's trace as 32 hexadecimal digits; `None` if it is not sampled. `session` is the id
    /// of the link's session, `request` the number of the request in it.
    fn trace_id(&self, session: &str, request: u64) -> Option<String>;
    /// Returns the number of spans that were dropped because nobody took them in time.
    fn dropped_spans(&self) -> u64;
}
