//! Which servants are ended so that others find capacity.

use super::{Amount, End, Servant};

/// Idle servants to end, those first that have been idle longest, until there will be capacity for all who wait: they
/// lack `lacking`.
pub fn make_room<'a>(
    mut lacking: Amount,
    servants: impl Iterator<Item = Servant<'a>>,
) -> Vec<End<'a>> {
    if lacking == Amount::NONE {
        return Vec::new();
    }
    let mut idle = Vec::new();
    for servant in servants {
        let Some(has) = servant.promised else {
            continue;
        };
        if servant.ending {
            // What it has is about to be free.
            lacking = lacking.minus(has);
        } else if let Some(until) = servant.idle_until {
            idle.push((until, servant.id, has));
        }
    }
    idle.sort_unstable_by_key(|(until, id, _)| (*until, *id));
    let mut ends = Vec::new();
    for (_, id, has) in idle {
        // It may have none of what is lacking.
        if lacking.minus(has) != lacking {
            lacking = lacking.minus(has);
            let reason = "its room was needed";
            ends.push(End { id, reason });
        }
    }
    ends
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn servant(id: &str, millicpus: u64, idle_until: Option<u64>) -> Servant<'_> {
        let memory = 0;
        Servant {
            id,
            revision: 1,
            connections: 0,
            promised: Some(Amount { millicpus, memory }),
            idle_until,
            ending: false,
        }
    }

    #[test]
    fn as_many_idle_servants_end_as_it_takes() {
        let newest = servant("newest", 500, Some(30));
        let oldest = servant("oldest", 500, Some(10));
        let middle = servant("middle", 500, Some(20));
        let busy = servant("busy", 500, None);
        let queued = Servant {
            promised: None,
            ..servant("queued", 0, Some(1))
        };
        let useless = servant("useless", 0, Some(5));
        let ending = Servant {
            ending: true,
            ..servant("ending", 1000, None)
        };
        let idle = [newest, busy, oldest, queued, useless, middle];
        for (lacking, extra, expected) in [
            (0, None, vec![]),
            (1, None, vec!["oldest"]),
            (500, None, vec!["oldest"]),
            (501, None, vec!["oldest", "middle"]),
            (9000, None, vec!["oldest", "middle", "newest"]),
            (1000, Some(ending), vec![]),
            (1100, Some(ending), vec!["oldest"]),
        ] {
            let lacking = Amount {
                millicpus: lacking,
                memory: 0,
            };
            let ends = make_room(lacking, idle.into_iter().chain(extra));
            let ids: Vec<&str> = ends.iter().map(|end| end.id).collect();
            assert_eq!(ids, expected, "{lacking:?}");
        }
        let memory = Amount {
            millicpus: 0,
            memory: 1,
        };
        assert!(
            make_room(memory, idle.into_iter()).is_empty(),
            "none has any"
        );
    }
}
