//! A pair, what is under way of it, and which input an output answers.

use std::collections::HashMap;
use std::sync::Arc;

use super::Governor;
use crate::pair::{Correlation, Pair};
use crate::request::{Key, RequestId, Side};

/// A pair, and what is under way of it.
#[derive(Debug)]
pub(super) struct Stream {
    pub(super) pair: Pair,
    pub(super) input: Arc<str>,
    pub(super) by: Correlation,
    pub(super) keys: HashMap<Key, RequestId>,
    /// By arrival: what each side has to answer next.
    pub(super) outstanding: [Option<RequestId>; 2],
    /// By arrival: what each side did not answer by T_max; if it does yet, it must not be taken for more.
    pub(super) owed: [Option<RequestId>; 2],
    /// Stamped outputs in a row that no input had; none once one has matched.
    pub(super) unmatched: Option<u32>,
}

impl Stream {
    pub(super) fn new(pair: Pair) -> Self {
        Self {
            input: pair.input.as_str().into(),
            by: pair.by.unwrap_or(Correlation::Arrival),
            pair,
            keys: HashMap::new(),
            outstanding: [None; 2],
            owed: [None; 2],
            unmatched: Some(0),
        }
    }

    pub(super) fn shown(&self) -> String {
        Pair {
            by: Some(self.by),
            ..self.pair.clone()
        }
        .to_string()
    }
}

impl<P: Clone> Governor<P> {
    /// Which request an output answers, and as which of its outputs.
    pub(super) fn request_of(
        &mut self,
        side: Side,
        topic: &str,
        key: Option<Key>,
    ) -> Option<(RequestId, usize)> {
        for stream in &mut self.pairs {
            let Some(output) = stream.pair.outputs.iter().position(|name| name == topic) else {
                continue;
            };
            if let Some(id) = key.as_ref().and_then(|key| stream.keys.get(key)) {
                stream.unmatched = None;
                return Some((*id, output));
            }
            if stream.by == Correlation::Goal {
                return None;
            }
            if stream.by == Correlation::Stamp {
                if stream.keys.is_empty() && stream.outstanding == [None; 2] {
                    return None;
                }
                if let Some(unmatched) = stream.unmatched.as_mut().filter(|_| output == 0) {
                    *unmatched += 1;
                }
            }
            if output > 0 {
                return None;
            }
            let slot = side.index();
            let id = stream.outstanding[slot]
                .take()
                .or_else(|| stream.owed[slot].take());
            return id.map(|id| (id, 0));
        }
        None
    }
}
