//! Recorded figures: their order, and how those of several samples are aggregated.

use api::explain::Served;
use api::history::{MachineFigures, ServantFigures};
use api::stream::Machine;
use api::{Millis, explain};

/// Aggregation of several samples of a figure.
#[derive(Debug, Clone, Copy)]
pub enum Aggregation {
    Mean,
    Most,
    Least,
    Last,
    Sum,
}
use Aggregation::{Last, Least, Mean, Most, Sum};

/// Aggregations of a servant's figures, in the order of recording. Append only.
pub const SERVANT: [Aggregation; 15] =
    [Mean, Most, Mean, Most, Mean, Most, Last, Last, Least, Sum, Mean, Mean, Mean, Mean, Mean];
/// Like [`SERVANT`], for the machine.
pub const MACHINE: [Aggregation; 8] = [Mean, Most, Mean, Most, Mean, Mean, Mean, Most];

/// Placeholder for an unknown figure.
const NONE: f32 = f32::NAN;

fn to_figure(value: Option<f64>) -> f32 {
    value.map_or(NONE, |value| value as f32)
}

/// Returns a servant's figures. `dropped` counts the messages dropped since the previous sample.
pub fn servant_sample(served: &Served, dropped: Option<u64>) -> Vec<f32> {
    let one = &served.servant;
    let used = one.usage.as_ref();
    let measured = |value: f64| to_figure(used.map(|_| value));
    let least = |all: &mut dyn Iterator<Item = Option<f64>>| to_figure(all.flatten().reduce(f64::min));
    let stated = || one.terms.iter().flat_map(|terms| terms.stated.values());
    let millis = |span: Option<api::Span>| span.map(|span| span.as_seconds() * 1e3);
    let links = &served.links;
    let slowest = links
        .iter()
        .filter_map(|link| Some((link, link.part("total")?.p50)))
        .max_by(|(_, one), (_, other)| one.total_cmp(other))
        .map(|(link, _)| link);
    let phase = |name| to_figure(slowest.and_then(|link: &explain::Link| Some(link.part(name)?.p50)));
    vec![
        measured(served.cores),
        measured(served.cores),
        measured(served.throttled),
        to_figure(used.map(|used| used.memory as f64)),
        to_figure(one.response.map(|response| response.p50_ms)),
        to_figure(one.response.map(|response| response.p95_ms)),
        least(&mut links.iter().map(|link| link.desire).chain(stated().map(|stated| millis(stated.sla.rrt)))),
        least(&mut links.iter().map(|link| link.max).chain(stated().map(|stated| millis(stated.sla.max_rrt)))),
        least(&mut links.iter().map(|link| link.satisfaction)),
        to_figure(dropped.map(|dropped| dropped as f64)),
        phase("serialise"),
        phase("up"),
        phase("queue"),
        phase("compute"),
        phase("down"),
    ]
}

/// Returns the machine's figures.
pub fn machine_sample(machine: &Machine) -> Vec<f32> {
    let status = &machine.status;
    let waits = status.usage.pressure;
    vec![
        machine.cores as f32,
        machine.cores as f32,
        status.capacity.cpus_reserved as f32,
        status.usage.memory as f32,
        to_figure(waits.map(|waits| waits.cpu)),
        to_figure(waits.map(|waits| waits.memory)),
        to_figure(waits.map(|waits| waits.io)),
        status.servants as f32,
    ]
}

/// Accumulates the samples of one step.
#[derive(Debug, Clone, Default)]
pub struct SampleAccumulator(Vec<Vec<f32>>);

impl SampleAccumulator {
    /// Adds a sample.
    pub fn add(&mut self, figures: Vec<f32>) {
        self.0.push(figures);
    }

    /// Aggregates all samples into one.
    pub fn aggregate(&self, rules: &[Aggregation]) -> Vec<f32> {
        let values = |index: usize| {
            let all = self.0.iter().filter_map(move |one| one.get(index).copied());
            all.filter(|value| !value.is_nan())
        };
        let gather = |(index, rule): (usize, &Aggregation)| {
            let all = || values(index);
            match rule {
                Aggregation::Mean => all().sum::<f32>() / all().count() as f32,
                Aggregation::Most => all().reduce(f32::max).unwrap_or(NONE),
                Aggregation::Least => all().reduce(f32::min).unwrap_or(NONE),
                Aggregation::Last => all().next_back().unwrap_or(NONE),
                Aggregation::Sum => all().reduce(|sum, one| sum + one).unwrap_or(NONE),
            }
        };
        rules.iter().enumerate().map(gather).collect()
    }
}

/// Rounds to four significant digits; more are not worth sending.
fn round_figure(value: Option<&f32>) -> Option<f64> {
    let value = f64::from(*value?);
    match value {
        _ if !value.is_finite() => None,
        0.0 => Some(0.0),
        _ => {
            let unit = 10_f64.powi(3 - value.abs().log10().floor() as i32);
            Some((value * unit).round() / unit)
        }
    }
}

type Samples = [(Millis, Vec<f32>)];

fn times(samples: &Samples) -> Vec<Millis> {
    samples.iter().map(|(time, _)| *time).collect()
}

fn list(samples: &Samples, index: usize) -> Vec<Option<f64>> {
    let of = samples.iter().map(|(_, figures)| round_figure(figures.get(index)));
    of.collect()
}

/// Converts samples to the API's type.
pub fn servant_figures(samples: &Samples) -> ServantFigures {
    let list = |index| list(samples, index);
    ServantFigures {
        time: times(samples),
        cores: list(0),
        cores_most: list(1),
        throttled: list(2),
        memory: list(3),
        p50: list(4),
        p95: list(5),
        desire: list(6),
        max: list(7),
        satisfaction: list(8),
        dropped: list(9),
        serialise: list(10),
        up: list(11),
        queue: list(12),
        compute: list(13),
        down: list(14),
    }
}

/// Converts samples to the API's type.
pub fn machine_figures(samples: &Samples) -> MachineFigures {
    let list = |index| list(samples, index);
    MachineFigures {
        time: times(samples),
        cores: list(0),
        cores_most: list(1),
        promised: list(2),
        memory: list(3),
        cpu_waits: list(4),
        memory_waits: list(5),
        io_waits: list(6),
        servants: list(7),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::looks::tests::served_servant;

    #[test]
    fn samples_are_gathered_each_by_its_rule() {
        let mut gathered = SampleAccumulator::default();
        gathered.add(vec![1.0, 1.0, 1.0, 1.0, 1.0, NONE]);
        gathered.add(vec![3.0, 3.0, 3.0, 3.0, 3.0, NONE]);
        gathered.add(vec![NONE, 2.0, 2.0, NONE, 2.0, NONE]);
        let one = gathered.aggregate(&[Mean, Most, Least, Last, Sum, Mean]);
        assert_eq!(one[..5], [2.0, 3.0, 1.0, 3.0, 6.0]);
        assert!(one[5].is_nan(), "of nothing comes nothing");
    }

    #[test]
    fn every_figure_has_a_rule_and_a_place() {
        let mut one = served_servant(1, 1);
        one.cores = 0.5;
        let phases = ["total", "serialise", "up", "queue", "compute", "down"];
        let link = |total: f64| explain::Link {
            desire: Some(total * 10.0),
            max: Some(total * 20.0),
            satisfaction: Some(2.0),
            phases: phases.iter().filter_map(|name| explain::Part::from_samples(name, vec![total])).collect(),
            ..explain::Link::default()
        };
        one.links = vec![link(3.0), link(7.0)];
        let figures = servant_sample(&one, Some(4));
        assert_eq!(figures.len(), SERVANT.len());
        let told = servant_figures(&[(5, figures)]);
        assert_eq!(told.time, [5]);
        assert_eq!((told.cores[0], told.p50[0]), (Some(0.5), None));
        // The strictest requirement; the phases of the slowest link.
        assert_eq!((told.desire[0], told.max[0]), (Some(30.0), Some(60.0)));
        assert_eq!((told.up[0], told.down[0]), (Some(7.0), Some(7.0)));
        assert_eq!(told.dropped[0], Some(4.0));
        assert_eq!(told.throttled.len(), 1);
    }

    #[test]
    fn figures_are_told_with_four_digits() {
        for (value, as_told) in [(1234567.0, 1235000.0), (0.123456, 0.1235), (-2.0, -2.0), (0.0, 0.0)] {
            assert_eq!(round_figure(Some(&value)), Some(as_told));
        }
        assert_eq!(round_figure(Some(&NONE)), None);
        assert_eq!(round_figure(None), None, "recorded before there was such a figure");
    }
}
