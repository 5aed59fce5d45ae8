//! Plots of programs with several limits of cores.

use anyhow::Result;

use crate::plots::{self, Series};

use super::model::Model;
use super::told::PUBLISHED;
use super::{LimitUse, ProgramFit, total_time};

/// Draws the model, the fitted points, and the points that were held back.
pub(super) fn draw_curve(one: &ProgramFit, model: &Model) -> Result<String> {
    let of = |of: LimitUse| {
        let chosen = one.points.iter().filter(move |point| point.2 == of);
        chosen.map(|point| (point.0, total_time(point.1))).collect()
    };
    let cores = || one.points.iter().map(|point| point.0);
    let (least, most) = (cores().fold(model.most, f64::min), cores().fold(model.most, f64::max));
    let steps = (0..=300).map(|step| least + (most - least) * f64::from(step) / 300.0);
    let curve = steps.map(|cores| (cores, model.predict_cautious(cores))).collect();
    // Points are drawn above the curve.
    let series = [
        Series::new("model", curve),
        Series::new("fitted", of(LimitUse::Fitted)),
        Series::new(LimitUse::Inside.name(), of(LimitUse::Inside)),
        Series::new(LimitUse::Beyond.name(), of(LimitUse::Beyond)),
    ];
    plots::points(one.name(), "cores of the servant", "mean response time (s)", &series, false)
}

/// Speedup over the native run on a Raspberry Pi by number of cores: predicted, and as published.
pub(super) fn speedup_series(found: &[ProgramFit]) -> Vec<Series> {
    let mut series = Vec::new();
    for one in found {
        let Some((model, native)) = one.model.zip(one.native) else {
            continue;
        };
        let over = |predict: fn(&Model, f64) -> f64| {
            let cores = (0..=20).map(|step| 32f64.powf(f64::from(step) / 20.0));
            cores.map(|cores| (cores, native / predict(&model, cores))).collect()
        };
        series.push(Series::new(format!("{}: cautious", one.name()), over(Model::predict_cautious)));
        if model.threads > 1 {
            series.push(Series::new(format!("{}: bound", one.name()), over(Model::predict_bound)));
        }
    }
    if !series.is_empty() {
        series.push(Series::new("published, up to", vec![(1.0, PUBLISHED), (32.0, PUBLISHED)]));
    }
    series
}
