//! Plots of programs with several limits of cores.

use anyhow::Result;

use crate::plots::{self, Series};

use super::model::Model;
use super::told::PUBLISHED;
use super::{Found, Use, total};

/// The model, points that were fitted, and points that were held back.
pub(super) fn curve(one: &Found, model: &Model) -> Result<String> {
    let of = |of: Use| {
        let chosen = one.points.iter().filter(move |point| point.2 == of);
        chosen.map(|point| (point.0, total(point.1))).collect()
    };
    let cores = || one.points.iter().map(|point| point.0);
    let (least, most) = (
        cores().fold(model.most, f64::min),
        cores().fold(model.most, f64::max),
    );
    let steps = (0..=300).map(|step| least + (most - least) * f64::from(step) / 300.0);
    let curve = steps.map(|cores| (cores, model.cautious(cores))).collect();
    // Points stand upon the curve.
    let series = [
        Series::new("model", curve),
        Series::new("fitted", of(Use::Fitted)),
        Series::new(Use::Inside.name(), of(Use::Inside)),
        Series::new(Use::Beyond.name(), of(Use::Beyond)),
    ];
    plots::points(
        one.name(),
        "cores of the servant",
        "mean response time (s)",
        &series,
        false,
    )
}

/// Times as fast as natively on the class Pi, by cores: predicted, and what the publication reached.
pub(super) fn factors(found: &[Found]) -> Vec<Series> {
    let mut series = Vec::new();
    for one in found {
        let Some((model, native)) = one.model.zip(one.native) else {
            continue;
        };
        let over = |predict: fn(&Model, f64) -> f64| {
            let cores = (0..=20).map(|step| 32f64.powf(f64::from(step) / 20.0));
            cores
                .map(|cores| (cores, native / predict(&model, cores)))
                .collect()
        };
        series.push(Series::new(
            format!("{}: cautious", one.name()),
            over(Model::cautious),
        ));
        if model.threads > 1 {
            series.push(Series::new(
                format!("{}: bound", one.name()),
                over(Model::bound),
            ));
        }
    }
    if !series.is_empty() {
        series.push(Series::new(
            "published, up to",
            vec![(1.0, PUBLISHED), (32.0, PUBLISHED)],
        ));
    }
    series
}
