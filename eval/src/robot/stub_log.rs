//! Reads the stub's log about each request.

use super::plan::FIRST;
use crate::trace::RequestSample;

/// Adds information from the stub's log: who gave the first answer to a request, and Q once it was counted.
pub(super) fn apply_stub_log(log: &str, requests: &mut [RequestSample]) {
    for line in log.lines() {
        let after = |key: &str| line.split(key).nth(1);
        let stamp = after("stamp=Some((").and_then(|rest| rest.split(',').next());
        let number = stamp.and_then(|number| number.parse::<u32>().ok());
        let index = number.and_then(|number| number.checked_sub(FIRST));
        let Some(request) = index.and_then(|index| requests.get_mut(index as usize)) else {
            continue;
        };
        request.local = line.contains("answer=Some((Local");
        let q = after(" q=").and_then(|rest| rest.split(' ').next()?.parse().ok());
        // Later log lines about a request do not change the value that Q had when it was counted.
        request.satisfaction = request.satisfaction.or(q);
    }
}

/// Counts in the stub's log, from the first measured request on, how often it asked the local original as well, no
/// longer asked it, started its process, and stopped it.
pub(super) fn count_handovers(log: &str) -> [usize; 4] {
    let begins = log.find(&format!("stamp=Some(({FIRST},")).unwrap_or(0);
    [
        "the local original answers, too",
        "the cloud answers alone",
        "the local original is started",
        "the local original is stopped",
    ]
    .map(|words| log[begins..].matches(words).count())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stubs_log_tells_who_answered_and_q() {
        let log = "DEBUG requests: id=1 name=/image stamp=Some((3, 0)) answer=Some((Cloud, 0.2)) cloud=Some(0.2) \
            q=15.5 phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=None q=7.5 \
            phases=None\n\
            DEBUG requests: id=2 name=/image stamp=Some((1001, 0)) answer=Some((Local, 0.3)) cloud=Some(2.5) q=3.75 \
            phases=None\n\
            INFO something else\n\
            DEBUG requests: id=9 name=/image stamp=Some((1009, 0)) answer=None cloud=None q=1 phases=None\n";
        let mut requests = vec![RequestSample::default(); 2];
        apply_stub_log(log, &mut requests);
        assert_eq!(requests[0], RequestSample::default());
        assert!(requests[1].local);
        assert_eq!(requests[1].satisfaction, Some(7.5));
    }

    #[test]
    fn handovers_count_from_the_first_measured_request_on() {
        let log = "INFO the cloud answers alone\nDEBUG requests: stamp=Some((1000, 0)) answer=None\n\
            INFO the local original is started\nINFO the local original answers, too\nINFO the cloud answers alone\n";
        assert_eq!(count_handovers(log), [1, 1, 1, 0]);
    }
}
