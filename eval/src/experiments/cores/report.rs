//! Section of the report on programs with several limits of cores: tables, findings and plots.

use super::model::{COMPUTATION, Model};
use super::{ABOUT, LimitUse, ProgramFit, ProgramStudy};
use crate::plots::{self, Series};
use crate::section::{AGAIN, Section, Table};
use crate::statistics::{Spread, root_mean_square_error};
use crate::trace::PART_NAMES;
use crate::words::{count, digits, milliseconds, or_dash, ratio, spread};

/// Numbers of cores for which response times are predicted.
const MANY: [f64; 5] = [4.0, 8.0, 16.0, 32.0, f64::INFINITY];
/// Greatest speedup of the publication (Fig. 5).
const PUBLISHED: f64 = 25.0;

pub fn section(studies: &[ProgramStudy]) -> Section {
    let mut section = ABOUT.section();
    let found: Vec<ProgramFit> = studies.iter().map(ProgramFit::from_study).collect();
    section.tables = vec![measured_table(&found), models_table(&found), predictions_table(&found)];
    for one in &found {
        add_missing(&mut section, one);
        if let Some(model) = &one.model {
            add_findings(&mut section, one, model);
            let id = one.name().replace(", ", "-").replace(' ', "-");
            let caption = format!("{}: mean response time by the servant's limit", one.name());
            section.add_drawing(format!("cores-{id}"), caption, draw_curve(one, model));
        }
    }
    section.add_drawing(
        "cores-predicted",
        "How many times as fast as on the robot itself, by cores of the cloud: predicted, beside the publication's \
         greatest factor",
        plots::lines("times as fast as the class Pi", "cores", "times as fast", &speedup_series(&found), true),
    );
    section
}

fn measured_table(found: &[ProgramFit]) -> Table {
    let parts = PART_NAMES.join(" | ");
    let mut table = Table::new(
        "Means by the servant's limit, which was read back from the kernel (milliseconds); robot of the class Pi, LAN",
        &format!("program | cores | used for | bytes a request | {parts} | response time | model | model's error"),
    );
    for one in found {
        for point in &one.points {
            let runs = one.study.runs.iter().find(|(cores, _)| *cores == point.cores).map(|(_, runs)| runs);
            let carried =
                runs.and_then(|runs| runs.figure(|run| run.trace.bytes_per_request(1).map(|ways| ways[0] + ways[1])));
            let enforced = runs.and_then(|runs| runs.figure(|run| Some(run.enforced)));
            let (whole, model) = (point.whole(), one.model.map(|model| model.predict_cautious(point.cores)));
            let mut row = vec![one.name().to_owned(), spread(enforced, digits), point.purpose.name().to_owned()];
            row.push(count(carried));
            row.extend((0..PART_NAMES.len()).map(|index| milliseconds(point.part(index))));
            row.push(milliseconds(whole));
            row.push(or_dash(model, |model| digits(model * 1e3)));
            row.push(or_dash(model.zip(whole), |(model, whole)| signed_percent(model / whole.median - 1.0)));
            table.push(row);
        }
    }
    table
}

fn signed_percent(share: f64) -> String {
    format!("{:+.1} %", 100.0 * share)
}

fn models_table(found: &[ProgramFit]) -> Table {
    let mut table = Table::new(
        "The models: overhead + work / min(cores, parallel)",
        "program | part | overhead (ms) | work (core ms) | parallel (cores)",
    );
    for one in found {
        for (name, part) in one.model.iter().flat_map(|model| PART_NAMES.iter().zip(model.parts)) {
            let numbers = [part.overhead * 1e3, part.work * 1e3, part.parallel].map(digits);
            table.push([one.name(), name].map(str::to_owned).into_iter().chain(numbers));
        }
    }
    table
}

/// Returns how many times as fast as natively a prediction is.
fn speedup(native: Option<Spread>, predicted: f64) -> Option<Spread> {
    native
        .and_then(|native| Spread::from_values(&[native.low, native.median, native.high].map(|time| time / predicted)))
}

fn predictions_table(found: &[ProgramFit]) -> Table {
    let mut table = Table::new(
        "Predicted, not measured: mean response times with more cores (milliseconds), and how many times as fast as \
         natively on the class Pi",
        "program | cores | native on the Pi, measured | cautious | times as fast | bound | \
         times as fast at most | published, up to",
    );
    for one in found {
        for (model, cores) in one.model.iter().flat_map(|model| MANY.map(|cores| (model, cores))) {
            let cores_name = if cores.is_finite() { cores.to_string() } else { "without end".to_owned() };
            let mut row = vec![one.name().to_owned(), cores_name, milliseconds(one.native)];
            for predicted in [model.predict_cautious(cores), model.predict_bound(cores)] {
                row.extend([digits(predicted * 1e3), ratio(speedup(one.native, predicted))]);
            }
            row.push(digits(PUBLISHED));
            table.push(row);
        }
    }
    table
}

fn add_findings(section: &mut Section, one: &ProgramFit, model: &Model) {
    let name = one.name();
    let inside = one.errors(LimitUse::Inside, Model::predict_cautious);
    let pairs: Vec<(f64, f64)> = inside.iter().map(|error| (*error, 0.0)).collect();
    section.findings.extend(root_mean_square_error(&pairs).map(|error| {
        let worst = inside.iter().map(|error| error.abs()).fold(0.0, f64::max);
        format!(
            "{name}: at the limits held back inside the fitted range ({}) the model's error is {:.1} % (root mean \
             square), at most {:.1} %.",
            inside.len(),
            100.0 * error,
            100.0 * worst
        )
    }));
    let beyond = |predict| one.errors(LimitUse::Beyond, predict).first().copied().map(signed_percent);
    section.findings.extend(beyond(Model::predict_cautious).map(|cautious| {
        let bound = beyond(Model::predict_bound).filter(|_| model.threads > 1);
        let bound = bound.map_or_else(String::new, |bound| format!(", that of the bound {bound}"));
        format!("{name}: beyond the fitted range the cautious prediction's error is {cautious}{bound}.")
    }));
    let computation = |cores: f64| one.points.iter().find(|point| point.cores == cores)?.part(COMPUTATION);
    let both = computation(1.0).zip(computation(model.most)).filter(|_| model.most > 1.0);
    section.findings.extend(both.map(|(alone, most)| {
        let end = match (model.has_end(), model.threads) {
            (false, _) => "no end of what cores give was seen".to_owned(),
            (true, 1) => format!("more than {} cores are not expected to give anything", digits(model.parallel())),
            (true, _) => format!(
                "above {} cores nothing was gained, by the program or by this machine, whose cores robot and daemon \
                 need as well",
                digits(model.parallel())
            ),
        };
        let (most_cores, times) = (digits(model.most), alone.median / most.median);
        format!(
            "{name}: with {most_cores} cores instead of one it computes {times:.2} times as fast ({} threads); {end}.",
            model.threads
        )
    }));
    let Some(native) = one.native else { return };
    let [cautious, bound] = [model.predict_cautious(32.0), model.predict_bound(f64::INFINITY)];
    let reached = if native.median / cautious >= PUBLISHED {
        "which reaches the published factor"
    } else if native.median / bound >= PUBLISHED {
        "between which the published factor lies: this machine cannot tell"
    } else {
        "below the published factor: what is left is transport and what is not divided"
    };
    section.findings.push(format!(
        "{name}: with 32 cores it would answer {} times as fast as on the class Pi by the cautious prediction, and \
         with cores without end at most {} times, {reached}.",
        ratio(speedup(one.native, cautious)),
        ratio(speedup(one.native, bound))
    ));
}

fn add_missing(section: &mut Section, one: &ProgramFit) {
    let native = format!("{}, native", one.name());
    one.study.native.require(section, &native);
    one.study.native.done.iter().for_each(|trace| section.note_early_end(&native, trace));
    for (cores, measured) in &one.study.runs {
        let what = format!("{}, {cores} cores", one.name());
        measured.require(section, &what);
        for run in &measured.done {
            section.note_early_end(&what, &run.trace);
            if run.trace.mean_parts().is_none() {
                section.add_missing(&what, "the package told no parts of its time", AGAIN);
            }
        }
    }
    if one.model.is_none() {
        let why = "fewer than three limits of those that it is fitted to were measured";
        section.add_missing(format!("{}: the model", one.name()), why, AGAIN);
    }
}

/// Draws the model, the fitted points, and the points that were held back.
fn draw_curve(one: &ProgramFit, model: &Model) -> String {
    let points = [LimitUse::Fitted, LimitUse::Inside, LimitUse::Beyond].map(|purpose| {
        let those = one.points.iter().filter(|point| point.purpose == purpose);
        Series::new(purpose.name(), those.filter_map(|point| Some((point.cores, point.whole()?.median))).collect())
    });
    let cores = || one.points.iter().map(|point| point.cores);
    let (least, most) = (cores().fold(model.most, f64::min), cores().fold(model.most, f64::max));
    let steps = (0..=300).map(|step| least + (most - least) * f64::from(step) / 300.0);
    let curve = Series::new("model", steps.map(|cores| (cores, model.predict_cautious(cores))).collect());
    plots::curves(one.name(), "cores of the servant", "mean response time (s)", &[curve], &points, false)
}

/// Speedup over the native run on a Raspberry Pi by number of cores: predicted, and as published.
fn speedup_series(found: &[ProgramFit]) -> Vec<Series> {
    let mut series = Vec::new();
    for one in found {
        let Some((model, native)) = one.model.zip(one.native) else {
            continue;
        };
        let over = |predict: fn(&Model, f64) -> f64| {
            let cores = (0..=20).map(|step| 32f64.powf(f64::from(step) / 20.0));
            cores.map(|cores| (cores, native.median / predict(&model, cores))).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cells::Runs;
    use crate::experiments::cores::{CoreLimitRun, SUBJECTS, Subject};
    use crate::place::RunCost;
    use crate::trace::{ComputationPhases, RequestSample, Trace};
    use crate::words::assert_tells;

    fn trace(computation: f64) -> Trace {
        let phases = Some(ComputationPhases { computation, ..ComputationPhases::default() });
        let request = RequestSample { response: Some(computation + 0.05), phases, ..RequestSample::default() };
        Trace { requests: vec![request], ..Trace::default() }
    }

    /// A tenth of a core second, divided among up to `parallel` cores; 50 ms of transport; 450 ms natively.
    fn study(subject: Subject, parallel: f64) -> ProgramStudy {
        let run = |cores: &f64| {
            let trace = trace(0.1 / cores.min(parallel));
            (*cores, Runs::from(CoreLimitRun { enforced: *cores, trace, cost: RunCost::default() }))
        };
        let runs = [subject.fitted, subject.held_back].concat().iter().map(run).collect();
        ProgramStudy { subject, native: Runs::from(trace(0.4)), runs }
    }

    #[test]
    fn the_report_has_errors_and_factors_beside_the_published_one() {
        let section = section(&[study(SUBJECTS[2], 8.0)]);
        assert!(section.missing.is_empty(), "{:?}", section.missing);
        assert_tells(&section.findings[0], "held back inside the fitted range (3) the model's error is 0.0 %");
        // 50 + 100 / 1.5 ms are predicted, 50 + 100 / 1.75 ms were measured.
        assert_tells(&section.findings[1], "error is +8.9 %, that of the bound +0.0 %");
        assert_tells(&section.findings[2], "1.50 times as fast (2 threads); no end");
        let rows = &section.tables[2].rows;
        // 450 ms divided by 50 + 100 / 1.5, and by 50 + 100 / 4.
        assert_eq!(rows[0][1..], ["4", "450", "117", "3.9", "75.0", "6.0", "25.0"]);
        assert_eq!(rows[4][5..], ["50.0", "9.0", "25.0"]);
        assert_eq!(section.figures.len(), 2);
    }

    #[test]
    fn a_program_of_one_thread_gains_nothing() {
        let section = section(&[study(SUBJECTS[1], 1.0)]);
        assert_tells(&section.findings[2], "more than 1.00 cores are not expected");
        assert_eq!(section.tables[2].rows[0][4], section.tables[2].rows[3][6]);
    }

    #[test]
    fn what_was_not_measured_is_named() {
        let mut study = study(SUBJECTS[2], 8.0);
        for (_, measured) in study.runs.iter_mut().take(2) {
            *measured = Runs::from_failure("no cgroups");
        }
        study.native = Runs::from_failure("no cgroups");
        let section = section(&[study]);
        assert_eq!(section.missing.len(), 4, "{:?}", section.missing);
        assert!(section.tables[2].rows.is_empty());
    }
}
