//! Limits the bytes of waiting messages that must all arrive (latched messages, messages of actions). Within the limit such
//! a message is not dropped in favour of a newer one.

use std::collections::VecDeque;

use super::{Out, Outgoing, count};
use crate::drops::Cause;

/// Bytes of such messages that may wait, over all topics, beside the last one; and that are kept until they are acknowledged.
pub(super) const EACH: usize = 64 << 20;
/// Bytes below which a topic's messages are not dropped, as long as another topic has more than its last message.
const LITTLE: usize = 1 << 20;

/// Whether a message may be kept beside so many bytes of others; a single message may have any size.
pub(super) fn has_room(kept: usize, out: &Out) -> bool {
    kept == 0 || kept + out.held() <= EACH
}

/// How many of them wait on a topic, and their bytes.
fn load(waiting: &VecDeque<Out>) -> (usize, usize) {
    let all = waiting.iter().filter(|out| out.counts());
    all.fold((0, 0), |(count, bytes), out| {
        (count + 1, bytes + out.held())
    })
}

impl Out {
    /// It is a message that no newer one replaces.
    fn counts(&self) -> bool {
        self.each && !self.closes
    }
}

impl Outgoing {
    /// Drops messages until the limit is kept, after one of `channel` was added: first messages that newer ones follow, then
    /// any, each time of the topic with the most bytes. The newest message stays.
    pub(super) fn keep_to_budget(&mut self, channel: u32) {
        loop {
            let topics = self.topics.iter().map(|(of, waiting)| (*of, load(waiting)));
            let topics: Vec<(u32, (usize, usize))> = topics.collect();
            let all: usize = topics.iter().map(|(_, (_, bytes))| bytes).sum();
            let last = self.topics.get(&channel).and_then(VecDeque::back);
            if all - last.map_or(0, Out::held).min(all) <= EACH {
                return;
            }
            let size = |&&(_, (_, bytes)): &&(u32, (usize, usize))| bytes;
            let followed = topics
                .iter()
                .filter(|(_, (count, bytes))| *count > 1 && *bytes > LITTLE);
            let others = topics
                .iter()
                .filter(|(of, (count, _))| *of != channel || *count > 1);
            let biggest = followed.max_by_key(size).or(others.max_by_key(size));
            let Some(&(of, _)) = biggest else { return };
            let Some(waiting) = self.topics.get_mut(&of) else {
                return;
            };
            let oldest = waiting.iter().position(Out::counts);
            if oldest.and_then(|at| waiting.remove(at)).is_none() {
                return;
            }
            if waiting.is_empty() {
                self.turns.retain(|turn| *turn != of);
            }
            count(&mut self.dropped, of, Cause::Full);
        }
    }
}
