//! What is made ahead of the robots that will ask: containers, and of some of them the nodes, too.

use std::time::Duration;

use super::{End, forecast};

/// Bytes that a container without nodes is counted with (some 3 MB were measured).
pub const CONTAINER: u64 = 4 << 20;
/// So many of the arrivals may find no container.
const LOSS: f64 = 0.05;
/// A pool is made smaller only where even fewer would find none: the sizes between are left as they are.
const KEPT_LOSS: f64 = 0.01;

/// A container of the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Warm<'a> {
    /// Its id.
    pub id: &'a str,
    /// The service whose servant it can become.
    pub service: &'a str,
    /// The revision that it was made from.
    pub revision: u64,
    /// The revision's image.
    pub image: &'a str,
    /// It has not ended, nor has a node in it.
    pub runs: bool,
    /// The revision's nodes were started in it, under their default names.
    pub nodes: bool,
}

impl Warm<'_> {
    /// Whether it was made from this revision of its service.
    pub fn is_of(&self, revision: u64, image: &str) -> bool {
        self.revision == revision && self.image == image
    }
}

/// The container for a robot that asks for this revision: one with nodes where it takes them as they are (`default_names`),
/// else, and where there is none, one without. The one that was made first is the furthest.
pub fn choose<'a>(
    pool: impl Iterator<Item = Warm<'a>>,
    (service, revision, image): (&str, u64, &str),
    default_names: bool,
) -> Option<Warm<'a>> {
    let fits = |warm: &Warm<'_>| {
        warm.service == service
            && warm.runs
            && warm.is_of(revision, image)
            && (default_names || !warm.nodes)
    };
    let mut best: Option<Warm<'a>> = None;
    for warm in pool.filter(fits) {
        if best.is_none_or(|best| warm.nodes && !best.nodes) {
            best = Some(warm);
        }
    }
    best
}

/// The `count` services of `published` that are to have containers: those asked for last first, `asked_for` having the last
/// one last, then those that nobody has asked for.
pub fn deserving(published: &[String], asked_for: &[String], count: usize) -> Vec<String> {
    let asked = asked_for.iter().rev().filter(|it| published.contains(it));
    let mut order: Vec<String> = Vec::new();
    for service in asked.chain(published) {
        if order.len() < count && !order.contains(service) {
            order.push(service.clone());
        }
    }
    order
}

/// What is known of a service that deserves containers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Demand {
    /// Robots that are expected in a second.
    pub rate: f64,
    /// From a container's taking to the next one's readiness.
    pub lead: Duration,
    /// Bytes that are promised to a servant; none where its nodes may not run ahead.
    pub nodes: Option<u64>,
}

/// What all that is made ahead may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget {
    /// Bytes.
    pub memory: u64,
    /// Containers whose nodes run.
    pub nodes: usize,
}

/// How many containers a service is to have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Size {
    /// So many are made.
    pub makes: usize,
    /// So many may stay.
    pub keeps: usize,
    /// Of those made, so many have nodes.
    pub nodes: usize,
}

/// The sizes of the services' pools, in their order, the most deserving first.
///
/// Each has one container while there is memory. Further ones go, one by one, to whoever spares most robots a wait by it, until
/// few enough would wait: the loss falls ever more slowly with each (Erlang's B is convex in the number), so that this is the
/// best division (B. Fox, *Discrete optimization via marginal analysis*, Management Science 13, 1966).
pub fn sizes(demands: &[Demand], budget: Budget) -> Vec<Size> {
    let mut left = budget.memory;
    let mut nodes_left = budget.nodes;
    let mut sizes = vec![Size::default(); demands.len()];
    let mut take = |cost: u64| {
        let has = left >= cost;
        left -= if has { cost } else { 0 };
        has
    };
    let offered: Vec<f64> = demands
        .iter()
        .map(|demand| demand.rate * demand.lead.as_secs_f64())
        .collect();
    for size in &mut sizes {
        size.makes = usize::from(take(CONTAINER));
    }
    for (size, demand) in sizes.iter_mut().zip(demands) {
        if let Some(cost) = demand.nodes
            && nodes_left > 0
            && size.makes > 0
            && take(cost)
        {
            size.nodes = 1;
            nodes_left -= 1;
        }
    }
    loop {
        let spared = |index: usize| {
            let (has, offered) = (sizes[index].makes, offered[index]);
            let waits = forecast::loss(has, offered);
            let spared = demands[index].rate * (waits - forecast::loss(has + 1, offered));
            (has > 0 && waits > LOSS).then_some((index, spared))
        };
        let most = (0..sizes.len())
            .filter_map(spared)
            .reduce(|best, next| if next.1 > best.1 { next } else { best });
        let Some((index, _)) = most.filter(|_| take(CONTAINER)) else {
            break;
        };
        sizes[index].makes += 1;
        if let Some(cost) = demands[index].nodes
            && nodes_left > 0
            && sizes[index].nodes > 0
            && take(cost)
        {
            sizes[index].nodes += 1;
            nodes_left -= 1;
        }
    }
    for (size, offered) in sizes.iter_mut().zip(offered) {
        size.keeps = size.makes;
        let enough = forecast::containers(offered, KEPT_LOSS);
        while size.keeps > 0 && size.keeps < enough && take(CONTAINER) {
            size.keeps += 1;
        }
    }
    sizes
}

/// A published revision that is to have containers in the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted<'a> {
    /// Its service.
    pub service: &'a str,
    /// Its number.
    pub revision: u64,
    /// Its image.
    pub image: &'a str,
    /// The number of containers.
    pub size: Size,
}

impl Wanted<'_> {
    fn has(&self, warm: &Warm<'_>) -> bool {
        warm.service == self.service && warm.is_of(self.revision, self.image)
    }
}

/// Those of `pool` that end: of none of the wanted revisions, not running, or more than are wanted. Of those it is the ones
/// without nodes that were made last.
pub fn stale<'a>(pool: &[Warm<'a>], wanted: &[Wanted<'_>]) -> Vec<End<'a>> {
    let mut ends = Vec::new();
    let mut end = |warm: &Warm<'a>, reason| {
        ends.push(End {
            id: warm.id,
            reason,
        });
    };
    for warm in pool {
        match wanted.iter().any(|wanted| wanted.has(warm)) {
            _ if !warm.runs => end(warm, "it does not run"),
            false => end(warm, "its revision is not wanted"),
            true => {}
        }
    }
    for wanted in wanted {
        let mut of: Vec<&Warm<'a>> = pool
            .iter()
            .filter(|warm| warm.runs && wanted.has(warm))
            .collect();
        let with = of.iter().filter(|warm| warm.nodes).count();
        // Memory is what nodes cost: they end as soon as they are too many.
        let (mut nodes, mut all) = (with.saturating_sub(wanted.size.nodes), of.len());
        of.reverse();
        of.sort_by_key(|warm| warm.nodes);
        for warm in of {
            if warm.nodes && nodes > 0 {
                nodes -= 1;
            } else if all <= wanted.size.keeps {
                continue;
            }
            all -= 1;
            end(warm, "fewer are needed");
        }
    }
    ends
}

/// What is done so that one of the wanted revisions has its containers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing<'a> {
    /// So many containers are made.
    Containers(usize),
    /// The nodes are started in this one.
    Nodes(&'a str),
    /// Nothing is to be done.
    Nothing,
}

/// What one of the wanted revisions lacks, `pool` being without those that end.
pub fn missing<'a>(pool: &[Warm<'a>], wanted: &Wanted<'_>) -> Missing<'a> {
    let of: Vec<&Warm<'a>> = pool.iter().filter(|warm| wanted.has(warm)).collect();
    if of.len() < wanted.size.makes {
        return Missing::Containers(wanted.size.makes - of.len());
    }
    let with = of.iter().filter(|warm| warm.nodes).count();
    let first = of.iter().find(|warm| !warm.nodes);
    match first {
        Some(warm) if with < wanted.size.nodes => Missing::Nodes(warm.id),
        _ => Missing::Nothing,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const WARM: Warm<'_> = Warm {
        id: "it",
        service: "a",
        revision: 2,
        image: "sha256:2",
        runs: true,
        nodes: false,
    };

    fn wanted(makes: usize, keeps: usize, nodes: usize) -> Wanted<'static> {
        Wanted {
            service: "a",
            revision: 2,
            image: "sha256:2",
            size: Size {
                makes,
                keeps,
                nodes,
            },
        }
    }

    #[test]
    fn the_services_asked_for_last_have_containers() {
        let names =
            |names: &[&str]| -> Vec<String> { names.iter().map(|it| (*it).into()).collect() };
        let published = names(&["a", "b", "c", "d"]);
        for (asked_for, count, expected) in [
            (names(&[]), 2, ["a", "b"].as_slice()),
            (names(&["gone", "d", "c"]), 3, &["c", "d", "a"]),
            (names(&["c"]), 0, &[]),
            (names(&["c"]), 9, &["c", "a", "b", "d"]),
        ] {
            let order = deserving(&published, &asked_for, count);
            assert_eq!(order, expected, "{asked_for:?}");
        }
    }

    #[test]
    fn a_robot_gets_nodes_only_where_it_takes_them_as_they_are() {
        let named = |id, nodes| Warm { id, nodes, ..WARM };
        let dead = Warm {
            runs: false,
            ..named("dead", true)
        };
        let older = Warm {
            revision: 1,
            ..named("older", true)
        };
        let pool = [
            dead,
            older,
            named("bare", false),
            named("first", true),
            named("second", true),
        ];
        let id = |pool: &[Warm<'static>], default_names| {
            let of = ("a", 2, "sha256:2");
            choose(pool.iter().copied(), of, default_names).map(|warm| warm.id)
        };
        assert_eq!(id(&pool, true), Some("first"));
        assert_eq!(id(&pool, false), Some("bare"));
        assert_eq!(id(&pool[..3], true), Some("bare"));
        assert_eq!(id(&pool[3..], false), None);
        assert_eq!(id(&pool[..2], true), None);
        // Of a service that was removed and published anew.
        assert!(choose(pool.into_iter(), ("a", 2, "sha256:1"), true).is_none());
        assert!(choose(pool.into_iter(), ("b", 2, "sha256:2"), true).is_none());
    }

    #[test]
    fn containers_end_that_do_not_run_are_not_wanted_or_too_many() {
        let ends = |pool: &[Warm<'static>], wanted| {
            let ends = stale(pool, &[wanted]);
            ends.into_iter().map(|end| end.id).collect::<Vec<_>>()
        };
        let one = wanted(1, 1, 0);
        for (warm, stays) in [
            (WARM, true),
            (
                Warm {
                    runs: false,
                    ..WARM
                },
                false,
            ),
            (
                Warm {
                    revision: 1,
                    ..WARM
                },
                false,
            ),
            (
                Warm {
                    image: "sha256:1",
                    ..WARM
                },
                false,
            ),
            (
                Warm {
                    service: "b",
                    ..WARM
                },
                false,
            ),
        ] {
            assert_eq!(ends(&[warm], one).is_empty(), stays, "{warm:?}");
        }
        let named = |id, nodes| Warm { id, nodes, ..WARM };
        let pool = [
            named("n1", true),
            named("b1", false),
            named("b2", false),
            named("n2", true),
        ];
        assert_eq!(ends(&pool, wanted(1, 4, 2)), [] as [&str; 0]);
        assert_eq!(ends(&pool, wanted(1, 3, 2)), ["b2"]);
        assert_eq!(ends(&pool, wanted(1, 4, 1)), ["n2"]);
        assert_eq!(ends(&pool, wanted(1, 1, 1)), ["b2", "b1", "n2"]);
        assert_eq!(ends(&pool, wanted(0, 0, 0)), ["b2", "b1", "n2", "n1"]);
    }

    #[test]
    fn containers_are_made_first_and_then_their_nodes() {
        let named = |id, nodes| Warm { id, nodes, ..WARM };
        let lacks = |pool: &[Warm<'static>], wanted| missing(pool, &wanted);
        assert_eq!(lacks(&[], wanted(2, 2, 1)), Missing::Containers(2));
        assert_eq!(
            lacks(&[named("n", true)], wanted(2, 2, 1)),
            Missing::Containers(1)
        );
        let two = [named("one", false), named("two", false)];
        assert_eq!(lacks(&two, wanted(2, 2, 1)), Missing::Nodes("one"));
        assert_eq!(lacks(&two, wanted(1, 2, 0)), Missing::Nothing);
        let warm = [named("n", true), named("b", false)];
        assert_eq!(lacks(&warm, wanted(2, 2, 1)), Missing::Nothing);
        assert_eq!(lacks(&warm, wanted(2, 2, 2)), Missing::Nodes("b"));
    }

    const DEMAND: Demand = Demand {
        rate: 0.0,
        lead: Duration::from_secs(1),
        nodes: Some(64 << 20),
    };

    #[test]
    fn pools_are_as_big_as_arrivals_need_and_memory_allows() {
        let busy = |rate| Demand { rate, ..DEMAND };
        let budget = |containers, nodes| Budget {
            memory: containers * CONTAINER + nodes as u64 * (64 << 20),
            nodes,
        };
        let makes = |demands: &[Demand], budget| {
            let sizes = sizes(demands, budget);
            let of = sizes.iter().map(|size| (size.makes, size.nodes));
            of.collect::<Vec<_>>()
        };
        assert_eq!(makes(&[DEMAND; 2], budget(9, 0)), [(1, 0), (1, 0)]);
        assert_eq!(makes(&[DEMAND; 2], budget(1, 0)), [(1, 0), (0, 0)]);
        assert_eq!(makes(&[DEMAND; 2], budget(9, 1)), [(1, 1), (1, 0)]);
        // Erlang's B of one in a lead time: 5 % with four.
        assert_eq!(makes(&[busy(1.0), DEMAND], budget(99, 0))[0], (4, 0));
        assert_eq!(makes(&[DEMAND, busy(1.0)], budget(4, 0)), [(1, 0), (3, 0)]);
        let nobodys = Demand {
            nodes: None,
            ..busy(1.0)
        };
        assert_eq!(makes(&[nobodys], budget(99, 3)), [(4, 0)]);
        assert_eq!(makes(&[busy(1.0)], budget(99, 9))[0].1, 4);
    }

    proptest! {
        #[test]
        fn sizes_keep_to_the_budget_and_move_little(
            services in prop::collection::vec((0.0f64..20.0, 1u64..3000, prop::option::of(1u64..300)), 0..9),
            memory in 0u64..600,
            nodes in 0usize..5,
        ) {
            let demands: Vec<Demand> = services.iter().map(|(rate, lead, nodes)| Demand {
                rate: *rate,
                lead: Duration::from_millis(*lead),
                nodes: nodes.map(|mib| mib << 20),
            }).collect();
            let budget = Budget { memory: memory << 20, nodes };
            let sizes = super::sizes(&demands, budget);
            prop_assert_eq!(&sizes, &super::sizes(&demands, budget));
            let mut costs = 0;
            for (size, demand) in sizes.iter().zip(&demands) {
                prop_assert!(size.makes <= size.keeps && size.nodes <= size.makes);
                prop_assert!(size.nodes == 0 || demand.nodes.is_some());
                costs += size.keeps as u64 * CONTAINER + size.nodes as u64 * demand.nodes.unwrap_or(0);
                let offered = demand.rate * demand.lead.as_secs_f64();
                // What is made is not ended again, and no size is between for ever.
                prop_assert!(size.makes <= forecast::containers(offered, LOSS).max(1));
                prop_assert!(size.keeps <= forecast::containers(offered, KEPT_LOSS).max(1));
            }
            prop_assert!(costs <= budget.memory);
            prop_assert!(sizes.iter().map(|size| size.nodes).sum::<usize>() <= nodes);
            // Who is more deserving has one first.
            let has: Vec<bool> = sizes.iter().map(|size| size.makes > 0).collect();
            prop_assert!(has.is_sorted_by(|one, other| one >= other));
        }

        #[test]
        fn what_is_done_about_a_pool_is_done_at_once(
            pool in prop::collection::vec((any::<bool>(), any::<bool>(), 1u64..3), 0..12),
            makes in 0usize..5,
            more in 0usize..3,
            nodes in 0usize..5,
        ) {
            let names: Vec<String> = (0..99).map(|n| n.to_string()).collect();
            let mut pool: Vec<Warm<'_>> = pool.iter().zip(&names).map(|((runs, nodes, revision), id)| Warm {
                id, runs: *runs, nodes: *nodes, revision: *revision, ..WARM
            }).collect();
            let wanted = wanted(makes, makes + more, nodes.min(makes));
            let mut next = 50;
            for round in 0.. {
                prop_assert!(round < 12, "it does not settle");
                let ends = stale(&pool, &[wanted]);
                let ended: Vec<&str> = ends.iter().map(|end| end.id).collect();
                prop_assert!(ended.iter().all(|id| pool.iter().any(|warm| warm.id == *id)));
                prop_assert!(round == 0 || ended.is_empty(), "what was made is ended");
                let before = pool.len();
                pool.retain(|warm| !ended.contains(&warm.id));
                prop_assert_eq!(pool.len() + ended.len(), before, "one is ended twice");
                match missing(&pool, &wanted) {
                    Missing::Nothing => break,
                    Missing::Nodes(id) => {
                        pool.iter_mut().filter(|warm| warm.id == id).for_each(|warm| warm.nodes = true);
                    }
                    Missing::Containers(count) => for _ in 0..count {
                        pool.push(Warm { id: &names[next], ..WARM });
                        next += 1;
                    },
                }
            }
            prop_assert!((makes..=makes + more).contains(&pool.len()));
            prop_assert_eq!(pool.iter().filter(|warm| warm.nodes).count(), nodes.min(makes));
        }
    }
}
