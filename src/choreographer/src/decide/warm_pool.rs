//! Decides what is prepared before robots ask: containers, and in some of them the nodes.

use std::time::Duration;

use super::{StopOrder, forecast};

/// Bytes counted for a container without nodes (some 3 MB were measured).
pub const CONTAINER: u64 = 4 << 20;
/// Fraction of arrivals that may find no container.
const LOSS: f64 = 0.05;
/// Fraction of arrivals without a container below which a pool is shrunk; sizes in between are left alone.
const KEPT_LOSS: f64 = 0.01;

/// A container of the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WarmContainer<'a> {
    /// Id of the container.
    pub id: &'a str,
    /// The service whose servant it can become.
    pub service: &'a str,
    /// The revision that it was made from.
    pub revision: u64,
    /// Image of the revision.
    pub image: &'a str,
    /// Neither it nor a node in it has ended.
    pub runs: bool,
    /// The revision's nodes were started in it, under their default names.
    pub nodes: bool,
}

impl WarmContainer<'_> {
    /// Returns true if it was made from this revision of its service.
    pub fn is_from(&self, revision: u64, image: &str) -> bool {
        self.revision == revision && self.image == image
    }
}

/// Chooses the container for a robot that requests this revision: one with nodes if the robot takes them unchanged
/// (`default_names`), otherwise, or if there is none, one without. The oldest container is the most advanced one.
pub fn choose_container<'a>(
    pool: impl Iterator<Item = WarmContainer<'a>>,
    (service, revision, image): (&str, u64, &str),
    default_names: bool,
) -> Option<WarmContainer<'a>> {
    let fits = |warm: &WarmContainer<'_>| {
        warm.service == service && warm.runs && warm.is_from(revision, image) && (default_names || !warm.nodes)
    };
    let mut best: Option<WarmContainer<'a>> = None;
    for warm in pool.filter(fits) {
        if best.is_none_or(|best| warm.nodes && !best.nodes) {
            best = Some(warm);
        }
    }
    best
}

/// Returns the `count` services of `published` that are to have containers: most recently requested first (`asked_for`
/// has the latest one last), then those that were never requested.
pub fn deserving_services(published: &[String], asked_for: &[String], count: usize) -> Vec<String> {
    let asked = asked_for.iter().rev().filter(|it| published.contains(it));
    let mut order: Vec<String> = Vec::new();
    for service in asked.chain(published) {
        if order.len() < count && !order.contains(service) {
            order.push(service.clone());
        }
    }
    order
}

/// Demand of a service that is to have containers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoolDemand {
    /// Expected robots per second.
    pub rate: f64,
    /// Time from taking a container until the next one is ready.
    pub lead: Duration,
    /// Bytes promised to a servant; `None` if its nodes may not run ahead.
    pub nodes: Option<u64>,
}

/// Budget for everything that is prepared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoolBudget {
    /// Memory in bytes.
    pub memory: u64,
    /// Number of containers with running nodes.
    pub nodes: usize,
}

/// Pool size of a service.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PoolSize {
    /// Number of containers to make.
    pub makes: usize,
    /// Number of containers that may stay.
    pub keeps: usize,
    /// Number of those made that have nodes.
    pub nodes: usize,
}

/// Returns the pool sizes of the services, in their order, most deserving first.
///
/// Each service gets one container while there is memory. Further ones go, one by one, to the service where they spare
/// most robots a wait, until few enough would wait: the loss falls ever more slowly with each (Erlang's B is convex in
/// the number), so this is the optimal division (B. Fox, *Discrete optimization via marginal analysis*, Management
/// Science 13, 1966).
pub fn pool_sizes(demands: &[PoolDemand], budget: PoolBudget) -> Vec<PoolSize> {
    let mut left = budget.memory;
    let mut nodes_left = budget.nodes;
    let mut sizes = vec![PoolSize::default(); demands.len()];
    let mut take = |cost: u64| {
        let has = left >= cost;
        left -= if has { cost } else { 0 };
        has
    };
    let offered: Vec<f64> = demands.iter().map(|demand| demand.rate * demand.lead.as_secs_f64()).collect();
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
            let waits = forecast::erlang_b(has, offered);
            let spared = demands[index].rate * (waits - forecast::erlang_b(has + 1, offered));
            (has > 0 && waits > LOSS).then_some((index, spared))
        };
        let most = (0..sizes.len()).filter_map(spared).reduce(|best, next| if next.1 > best.1 { next } else { best });
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
        let enough = forecast::containers_needed(offered, KEPT_LOSS);
        while size.keeps > 0 && size.keeps < enough && take(CONTAINER) {
            size.keeps += 1;
        }
    }
    sizes
}

/// A published revision that is to have containers in the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WantedPool<'a> {
    /// The service.
    pub service: &'a str,
    /// Revision number.
    pub revision: u64,
    /// Image of the revision.
    pub image: &'a str,
    /// Pool size.
    pub size: PoolSize,
}

impl WantedPool<'_> {
    fn includes(&self, warm: &WarmContainer<'_>) -> bool {
        warm.service == self.service && warm.is_from(self.revision, self.image)
    }
}

/// Returns the containers of `pool` to end: of none of the wanted revisions, not running, or too many. Of the latter,
/// those without nodes that were made last come first.
pub fn stale_containers<'a>(pool: &[WarmContainer<'a>], wanted: &[WantedPool<'_>]) -> Vec<StopOrder<'a>> {
    let mut ends = Vec::new();
    let mut end = |warm: &WarmContainer<'a>, reason| {
        ends.push(StopOrder { id: warm.id, reason });
    };
    for warm in pool {
        if !warm.runs {
            end(warm, "it is not running");
        } else if !wanted.iter().any(|wanted| wanted.includes(warm)) {
            end(warm, "its revision is not needed");
        }
    }
    for wanted in wanted {
        let mut of: Vec<&WarmContainer<'a>> = pool.iter().filter(|warm| warm.runs && wanted.includes(warm)).collect();
        let with = of.iter().filter(|warm| warm.nodes).count();
        // Nodes cost memory: they end as soon as there are too many.
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

/// Containers or nodes that a wanted revision is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoolShortage<'a> {
    /// So many containers are to be made.
    Containers(usize),
    /// The nodes are to be started in this container.
    Nodes(&'a str),
    /// Nothing is missing.
    Nothing,
}

/// Returns what a wanted revision is missing; `pool` excludes the containers that end.
pub fn pool_shortage<'a>(pool: &[WarmContainer<'a>], wanted: &WantedPool<'_>) -> PoolShortage<'a> {
    let of: Vec<&WarmContainer<'a>> = pool.iter().filter(|warm| wanted.includes(warm)).collect();
    if of.len() < wanted.size.makes {
        return PoolShortage::Containers(wanted.size.makes - of.len());
    }
    let with = of.iter().filter(|warm| warm.nodes).count();
    let first = of.iter().find(|warm| !warm.nodes);
    match first {
        Some(warm) if with < wanted.size.nodes => PoolShortage::Nodes(warm.id),
        _ => PoolShortage::Nothing,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const WARM: WarmContainer<'_> =
        WarmContainer { id: "it", service: "a", revision: 2, image: "sha256:2", runs: true, nodes: false };

    fn wanted_pool(makes: usize, keeps: usize, nodes: usize) -> WantedPool<'static> {
        WantedPool { service: "a", revision: 2, image: "sha256:2", size: PoolSize { makes, keeps, nodes } }
    }

    #[test]
    fn the_services_asked_for_last_have_containers() {
        let names = |names: &[&str]| -> Vec<String> { names.iter().map(|it| (*it).into()).collect() };
        let published = names(&["a", "b", "c", "d"]);
        for (asked_for, count, expected) in [
            (names(&[]), 2, ["a", "b"].as_slice()),
            (names(&["gone", "d", "c"]), 3, &["c", "d", "a"]),
            (names(&["c"]), 0, &[]),
            (names(&["c"]), 9, &["c", "a", "b", "d"]),
        ] {
            let order = deserving_services(&published, &asked_for, count);
            assert_eq!(order, expected, "{asked_for:?}");
        }
    }

    #[test]
    fn a_robot_gets_nodes_only_where_it_takes_them_as_they_are() {
        let named = |id, nodes| WarmContainer { id, nodes, ..WARM };
        let dead = WarmContainer { runs: false, ..named("dead", true) };
        let older = WarmContainer { revision: 1, ..named("older", true) };
        let pool = [dead, older, named("bare", false), named("first", true), named("second", true)];
        let id = |pool: &[WarmContainer<'static>], default_names| {
            let of = ("a", 2, "sha256:2");
            choose_container(pool.iter().copied(), of, default_names).map(|warm| warm.id)
        };
        assert_eq!(id(&pool, true), Some("first"));
        assert_eq!(id(&pool, false), Some("bare"));
        assert_eq!(id(&pool[..3], true), Some("bare"));
        assert_eq!(id(&pool[3..], false), None);
        assert_eq!(id(&pool[..2], true), None);
        // Of a service that was removed and published anew.
        assert!(choose_container(pool.into_iter(), ("a", 2, "sha256:1"), true).is_none());
        assert!(choose_container(pool.into_iter(), ("b", 2, "sha256:2"), true).is_none());
    }

    #[test]
    fn containers_end_that_do_not_run_are_not_wanted_or_too_many() {
        let ends = |pool: &[WarmContainer<'static>], wanted| {
            let ends = stale_containers(pool, &[wanted]);
            ends.into_iter().map(|end| end.id).collect::<Vec<_>>()
        };
        let one = wanted_pool(1, 1, 0);
        for (warm, stays) in [
            (WARM, true),
            (WarmContainer { runs: false, ..WARM }, false),
            (WarmContainer { revision: 1, ..WARM }, false),
            (WarmContainer { image: "sha256:1", ..WARM }, false),
            (WarmContainer { service: "b", ..WARM }, false),
        ] {
            assert_eq!(ends(&[warm], one).is_empty(), stays, "{warm:?}");
        }
        let named = |id, nodes| WarmContainer { id, nodes, ..WARM };
        let pool = [named("n1", true), named("b1", false), named("b2", false), named("n2", true)];
        assert_eq!(ends(&pool, wanted_pool(1, 4, 2)), [] as [&str; 0]);
        assert_eq!(ends(&pool, wanted_pool(1, 3, 2)), ["b2"]);
        assert_eq!(ends(&pool, wanted_pool(1, 4, 1)), ["n2"]);
        assert_eq!(ends(&pool, wanted_pool(1, 1, 1)), ["b2", "b1", "n2"]);
        assert_eq!(ends(&pool, wanted_pool(0, 0, 0)), ["b2", "b1", "n2", "n1"]);
    }

    #[test]
    fn containers_are_made_first_and_then_their_nodes() {
        let named = |id, nodes| WarmContainer { id, nodes, ..WARM };
        let lacks = |pool: &[WarmContainer<'static>], wanted| pool_shortage(pool, &wanted);
        assert_eq!(lacks(&[], wanted_pool(2, 2, 1)), PoolShortage::Containers(2));
        assert_eq!(lacks(&[named("n", true)], wanted_pool(2, 2, 1)), PoolShortage::Containers(1));
        let two = [named("one", false), named("two", false)];
        assert_eq!(lacks(&two, wanted_pool(2, 2, 1)), PoolShortage::Nodes("one"));
        assert_eq!(lacks(&two, wanted_pool(1, 2, 0)), PoolShortage::Nothing);
        let warm = [named("n", true), named("b", false)];
        assert_eq!(lacks(&warm, wanted_pool(2, 2, 1)), PoolShortage::Nothing);
        assert_eq!(lacks(&warm, wanted_pool(2, 2, 2)), PoolShortage::Nodes("b"));
    }

    const DEMAND: PoolDemand = PoolDemand { rate: 0.0, lead: Duration::from_secs(1), nodes: Some(64 << 20) };

    #[test]
    fn pools_are_as_big_as_arrivals_need_and_memory_allows() {
        let busy = |rate| PoolDemand { rate, ..DEMAND };
        let budget =
            |containers, nodes| PoolBudget { memory: containers * CONTAINER + nodes as u64 * (64 << 20), nodes };
        let makes = |demands: &[PoolDemand], budget| {
            let sizes = pool_sizes(demands, budget);
            let of = sizes.iter().map(|size| (size.makes, size.nodes));
            of.collect::<Vec<_>>()
        };
        assert_eq!(makes(&[DEMAND; 2], budget(9, 0)), [(1, 0), (1, 0)]);
        assert_eq!(makes(&[DEMAND; 2], budget(1, 0)), [(1, 0), (0, 0)]);
        assert_eq!(makes(&[DEMAND; 2], budget(9, 1)), [(1, 1), (1, 0)]);
        // Erlang's B of one in a lead time: 5 % with four.
        assert_eq!(makes(&[busy(1.0), DEMAND], budget(99, 0))[0], (4, 0));
        assert_eq!(makes(&[DEMAND, busy(1.0)], budget(4, 0)), [(1, 0), (3, 0)]);
        let nobodys = PoolDemand { nodes: None, ..busy(1.0) };
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
            let demands: Vec<PoolDemand> = services.iter().map(|(rate, lead, nodes)| PoolDemand {
                rate: *rate,
                lead: Duration::from_millis(*lead),
                nodes: nodes.map(|mib| mib << 20),
            }).collect();
            let budget = PoolBudget { memory: memory << 20, nodes };
            let sizes = super::pool_sizes(&demands, budget);
            prop_assert_eq!(&sizes, &super::pool_sizes(&demands, budget));
            let mut costs = 0;
            for (size, demand) in sizes.iter().zip(&demands) {
                prop_assert!(size.makes <= size.keeps && size.nodes <= size.makes);
                prop_assert!(size.nodes == 0 || demand.nodes.is_some());
                costs += size.keeps as u64 * CONTAINER + size.nodes as u64 * demand.nodes.unwrap_or(0);
                let offered = demand.rate * demand.lead.as_secs_f64();
                // A new container is not ended again, and no size stays in between for ever.
                prop_assert!(size.makes <= forecast::containers_needed(offered, LOSS).max(1));
                prop_assert!(size.keeps <= forecast::containers_needed(offered, KEPT_LOSS).max(1));
            }
            prop_assert!(costs <= budget.memory);
            prop_assert!(sizes.iter().map(|size| size.nodes).sum::<usize>() <= nodes);
            // More deserving services get one first.
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
            let mut pool: Vec<WarmContainer<'_>> = pool.iter().zip(&names).map(|((runs, nodes, revision),
                id)| WarmContainer {
                id, runs: *runs, nodes: *nodes, revision: *revision, ..WARM
            }).collect();
            let wanted = wanted_pool(makes, makes + more, nodes.min(makes));
            let mut next = 50;
            for round in 0.. {
                prop_assert!(round < 12, "it does not settle");
                let ends = stale_containers(&pool, &[wanted]);
                let ended: Vec<&str> = ends.iter().map(|end| end.id).collect();
                prop_assert!(ended.iter().all(|id| pool.iter().any(|warm| warm.id == *id)));
                prop_assert!(round == 0 || ended.is_empty(), "what was made is ended");
                let before = pool.len();
                pool.retain(|warm| !ended.contains(&warm.id));
                prop_assert_eq!(pool.len() + ended.len(), before, "one is ended twice");
                match pool_shortage(&pool, &wanted) {
                    PoolShortage::Nothing => break,
                    PoolShortage::Nodes(id) => {
                        pool.iter_mut().filter(|warm| warm.id == id).for_each(|warm| warm.nodes = true);
                    }
                    PoolShortage::Containers(count) => for _ in 0..count {
                        pool.push(WarmContainer { id: &names[next], ..WARM });
                        next += 1;
                    },
                }
            }
            prop_assert!((makes..=makes + more).contains(&pool.len()));
            prop_assert_eq!(pool.iter().filter(|warm| warm.nodes).count(), nodes.min(makes));
        }
    }
}
