//! Section of the report on programs with several limits of cores: tables, findings and plots.

use anyhow::Result;

use crate::plots;
use crate::section::{AGAIN, MissingMeasurement, Section, Table};
use crate::statistics::root_mean_square_error;
use crate::words::{digits, milliseconds, or_dash, percent, ratio};

use super::drawn::{draw_curve, speedup_series};
use super::model::{Model, NAMES, mean_parts};
use super::{LimitUse, ProgramFit, ProgramStudy, total_time};

/// Numbers of cores for which response times are predicted.
const MANY: [f64; 4] = [4.0, 8.0, 16.0, 32.0];
/// Greatest speedup of the publication (Fig. 5).
pub(super) const PUBLISHED: f64 = 25.0;

/// Error within the fitted range above which the report gives a reason.
const POOR: f64 = 0.1;
/// Speedup from which on a program is said to have gained by a limit above the fitted range.
const GAINED: f64 = 1.05;

/// Creates the section of the report.
pub fn section(studies: &[ProgramStudy]) -> Result<Section> {
    let mut section =
        Section::new(2, "cores", "What more cores would give: a model, and its error at points that were held back");
    section.published = format!(
        "Fig. 5 of the publication: outsourced to a cloud of many cores, packages answered up to {PUBLISHED} times as \
         fast as on a Raspberry Pi."
    );
    section.differs = differences();
    let found: Vec<ProgramFit> = studies.iter().map(ProgramFit::from_study).collect();
    section.tables = vec![measured_table(&found), models_table(&found), predictions_table(&found)];
    for one in &found {
        add_findings(&mut section, one);
        add_missing(&mut section, one);
        if let Some(model) = &one.model {
            let id = one.name().replace([',', ' '], "-").replace("--", "-");
            section.add_drawing(
                format!("cores-{id}"),
                format!("{}: mean response time by the servant's limit", one.name()),
                draw_curve(one, model)?,
            );
        }
    }
    section.add_drawing(
        "cores-predicted",
        "How many times as fast as on the robot itself, by cores of the cloud: predicted, beside the publication's \
         greatest factor",
        plots::lines(
            "times as fast as a robot of the class Pi",
            "cores",
            "times as fast",
            &speedup_series(&found),
            true,
        )?,
    );
    Ok(section)
}

fn differences() -> Vec<String> {
    let here = std::thread::available_parallelism().map_or(0, usize::from);
    vec![
        format!(
            "This machine has {here} cores, which robot, daemon and servant share; all above the greatest measured \
             limit is predicted, not measured."
        ),
        "Each part of the response time (acquisition, computation and rendering as the package tells them; the rest is \
         transport and waiting) has a model of its own: overhead + work / min(cores, parallel), fitted to means of \
         whole runs.".to_owned(),
        "A limit of a fraction of a core is not a slow core: the kernel lets the program run at full speed for a part \
         of each tenth of a second and stops it for the rest (CFS bandwidth control). One request may pass without \
         being stopped, the next one waits; only means follow the limit. The same holds for limits between one core \
         and two, and what was measured there says nothing of caches, memory bandwidth or sockets of a machine with \
         many cores.".to_owned(),
        "Two predictions are given. The cautious one: more cores than were measured give nothing more. The bound, for \
         programs with more than one thread: all work of the computation is divided among all cores as among the first \
         ones, without an end; the package would have to be started with that many threads.".to_owned(),
        "The model cannot know cores of another speed (the cloud's core is four times the Pi class's quarter here, \
         because it is the same core), a GPU, what several robots do to each other, or another network than the LAN \
         that was measured.".to_owned(),
    ]
}

fn measured_table(found: &[ProgramFit]) -> Table {
    let mut table = Table::new(
        "Means by the servant's limit, which was read back from the kernel (milliseconds); robot of the class Pi, LAN",
        &format!(
            "program | cores | used for | requests | bytes a request, both ways | {} | response time | model | \
             model's error",
            NAMES.join(" | ")
        ),
    );
    for one in found {
        for (cores, measured) in &one.study.runs {
            let point = one.points.iter().find(|point| point.0 == *cores);
            let (Some(run), Some((_, parts, of))) = (measured.value(), point) else {
                continue;
            };
            let (whole, model) = (total_time(*parts), one.model.map(|model| model.predict_cautious(*cores)));
            let mut row = vec![
                one.name().to_owned(),
                digits(run.enforced),
                of.name().to_owned(),
                run.trace.answered_count().to_string(),
                or_dash(run.trace.bytes_per_request(1), |ways| format!("{:.0}", ways[0] + ways[1])),
            ];
            row.extend(parts.map(|part| milliseconds(Some(part))));
            row.extend([Some(whole), model].map(milliseconds));
            row.push(or_dash(model, |model| signed_percent(model / whole - 1.0)));
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
        for (name, part) in one.model.iter().flat_map(|model| NAMES.iter().zip(model.parts)) {
            table.push([
                one.name().to_owned(),
                (*name).to_owned(),
                milliseconds(Some(part.overhead)),
                milliseconds(Some(part.work)),
                digits(part.parallel),
            ]);
        }
    }
    table
}

fn predictions_table(found: &[ProgramFit]) -> Table {
    let mut table = Table::new(
        "Predicted, not measured: mean response times with more cores (milliseconds), and how many times as fast as \
         natively on the class Pi, by means",
        "program | cores | native on the Pi, measured | cautious | times as fast | bound | \
         times as fast at most | published, up to",
    );
    for one in found {
        let Some(model) = &one.model else { continue };
        for cores in MANY.into_iter().chain([f64::INFINITY]) {
            let (cautious, bound) = (model.predict_cautious(cores), model.predict_bound(cores));
            let times = |predicted: f64| ratio(one.native.map(|native| native / predicted));
            table.push([
                one.name().to_owned(),
                if cores.is_finite() { cores.to_string() } else { "without end".to_owned() },
                milliseconds(one.native),
                milliseconds(Some(cautious)),
                times(cautious),
                milliseconds(Some(bound)),
                times(bound),
                ratio(Some(PUBLISHED)),
            ]);
        }
    }
    table
}

fn add_findings(section: &mut Section, one: &ProgramFit) {
    let (name, subject) = (one.name(), &one.study.subject);
    let Some(model) = &one.model else { return };
    section.findings.extend(inside_finding(one));
    section.findings.extend(beyond_finding(one, model));
    if let Some((alone, most)) = computation(one, 1.0).zip(computation(one, model.most)) {
        if model.most > 1.0 {
            let threads = match subject.threads {
                1 => "one thread".to_owned(),
                many => format!("{many} threads"),
            };
            section.findings.push(format!(
                "{name}: with {} cores instead of one it computes {:.2} times as fast with {threads}, so {}.",
                digits(model.most),
                alone / most,
                limit_finding(one, model)
            ));
        }
    }
    let Some(native) = one.native else { return };
    let (cautious, bound) = (model.predict_cautious(32.0), model.predict_bound(f64::INFINITY));
    let reached = if native / cautious >= PUBLISHED {
        "which reaches the published factor"
    } else if native / bound >= PUBLISHED {
        "between which the published factor lies: this machine cannot tell"
    } else {
        "below the published factor: what is left is transport and what is not divided"
    };
    section.findings.push(format!(
        "{name}: with 32 cores it would answer {:.1} times as fast as on the class Pi by the cautious prediction, and \
         with cores without end at most {:.1} times, {reached}.",
        native / cautious,
        native / bound
    ));
}

/// Reports the error of the model between the limits to which it was fitted.
fn inside_finding(one: &ProgramFit) -> Option<String> {
    let pairs = one.pairs(LimitUse::Inside, Model::predict_cautious);
    let relative: Vec<(f64, f64)> = pairs.iter().map(|(predicted, measured)| (predicted / measured, 1.0)).collect();
    let error = root_mean_square_error(&relative)?;
    let worst = relative.iter().map(|pair| (pair.0 - 1.0).abs());
    let why = if error > POOR { changing_work_finding(one).unwrap_or_default() } else { String::new() };
    let limits = match pairs.len() {
        1 => "the limit that was held back".to_owned(),
        many => format!("the {many} limits that were held back"),
    };
    Some(format!(
        "{}: at {limits} inside the fitted range the model's error is {} (root mean square), at most {}{why}.",
        one.name(),
        percent(Some(error)),
        percent(Some(worst.fold(0.0, f64::max)))
    ))
}

/// Returns the computation time at a limit of cores, in seconds.
fn computation(one: &ProgramFit, cores: f64) -> Option<f64> {
    let of = one.points.iter().find(|point| point.0 == cores);
    of.map(|point| point.1[1])
}

/// Reports the work per request at limits of up to one core, which the model assumes to be constant.
fn changing_work_finding(one: &ProgramFit) -> Option<String> {
    let limits = one.points.iter().map(|point| point.0);
    let least = limits.clone().reduce(f64::min)?;
    let most = limits.filter(|cores| *cores <= 1.0).reduce(f64::max)?;
    let work = |cores| Some(milliseconds(Some(cores * computation(one, cores)?)));
    Some(format!(
        ", which is worse than hoped: a request's computation is {} core ms at {} cores and {} core ms at {}, while \
         the model has the same work at each limit",
        work(least)?,
        digits(least),
        work(most)?,
        digits(most)
    ))
}

/// Reports the errors of both predictions at the limit above the fitted ones.
fn beyond_finding(one: &ProgramFit, model: &Model) -> Option<String> {
    let cores = one.points.iter().find(|point| point.2 == LimitUse::Beyond)?.0;
    let error = |predict: fn(&Model, f64) -> f64| {
        let (predicted, measured) = *one.pairs(LimitUse::Beyond, predict).first()?;
        Some(signed_percent(predicted / measured - 1.0))
    };
    let bound = (model.threads > 1).then(|| error(Model::predict_bound)).flatten();
    Some(format!(
        "{}: beyond the fitted range, at {} cores where it goes to {}, the cautious prediction's error is {}{}.",
        one.name(),
        digits(cores),
        digits(model.most),
        error(Model::predict_cautious)?,
        bound.map(|bound| format!(", that of the bound {bound}")).unwrap_or_default()
    ))
}

/// Reports how many cores the program can use according to the measurements.
fn limit_finding(one: &ProgramFit, model: &Model) -> String {
    let end = digits(model.parts[1].parallel);
    let beyond = one.points.iter().find(|point| point.2 == LimitUse::Beyond);
    let further = beyond.and_then(|point| Some((point.0, computation(one, model.most)? / point.1[1])));
    match (model.has_end(), model.threads) {
        (false, _) => match further {
            Some((cores, faster)) if faster < GAINED => format!(
                "the model has no end of what cores give, but with {} cores, which were held back, it computes only \
                 {faster:.2} times as fast as with {}: whether the program ends there or this machine, whose cores \
                 robot and daemon need as well, was not measured",
                digits(cores),
                digits(model.most)
            ),
            _ => "no end of what cores give was seen; where it is, was not measured".to_owned(),
        },
        (true, 1) => format!("more than {end} cores are not expected to give anything"),
        (true, _) => format!(
            "above {end} cores nothing was gained: whether the program ends there or this machine, whose cores robot \
             and daemon need as well, was not measured"
        ),
    }
}

fn add_missing(section: &mut Section, one: &ProgramFit) {
    let native = format!("{}, native", one.name());
    if let Some(trace) = one.study.native.require(section, &native, AGAIN) {
        section.note_early_end(format!("{native}: to its end"), trace);
    }
    for (cores, measured) in &one.study.runs {
        let what = format!("{}, {cores} cores", one.name());
        let Some(run) = measured.require(section, &what, AGAIN) else {
            continue;
        };
        if mean_parts(&run.trace).is_none() {
            let why = "the package told no parts of its time";
            let missing = MissingMeasurement::retryable(what, why);
            section.missing.push(missing);
        } else {
            section.note_early_end(format!("{what}: to its end"), &run.trace);
        }
    }
    if one.model.is_none() {
        section.missing.push(MissingMeasurement::retryable(
            format!("{}: the model", one.name()),
            "fewer than three limits of those that it is fitted to were measured",
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cells::CachedResult;
    use crate::experiments::cores::{CoreLimitRun, SUBJECTS, Subject};
    use crate::place::RunCost;
    use crate::trace::{ComputationPhases, RequestSample, Trace};
    use crate::words::assert_tells;

    fn trace(computation: f64) -> Trace {
        Trace {
            requests: vec![RequestSample {
                response: Some(computation + 0.05),
                phases: Some(ComputationPhases { computation, ..ComputationPhases::default() }),
                ..RequestSample::default()
            }],
            ..Trace::default()
        }
    }

    /// A tenth of a core second, divided among up to `parallel` cores; 50 ms of transport; 450 ms natively.
    fn study(subject: Subject, parallel: f64) -> ProgramStudy {
        let run = |cores: &f64| {
            let reading =
                CoreLimitRun { enforced: *cores, trace: trace(0.1 / cores.min(parallel)), cost: RunCost::default() };
            (*cores, CachedResult::Done(reading))
        };
        ProgramStudy {
            subject,
            native: CachedResult::Done(trace(0.4)),
            runs: [subject.fitted, subject.held_back].concat().iter().map(run).collect(),
        }
    }

    #[test]
    fn the_report_has_errors_and_factors_beside_the_published_one() {
        let section = section(&[study(SUBJECTS[2], 8.0)]).expect("it is drawn");
        assert!(section.missing.is_empty(), "{:?}", section.missing);
        assert_tells(
            &section.findings[0],
            "3 limits that were held back inside the fitted range the model's error is 0.0 %",
        );
        // 50 + 100 / 1.5 ms are predicted, 50 + 100 / 1.75 ms were measured.
        assert_tells(&section.findings[1], "error is +8.9 %, that of the bound +0.0 %");
        assert!(section.findings[2].contains("1.50 times as fast with 2 threads"));
        let four = &section.tables[2].rows[0];
        // 450 ms divided by 50 + 100 / 1.5, and by 50 + 100 / 4.
        assert_eq!(four[1..], ["4", "450", "117", "3.9", "75.0", "6.0", "25.0"]);
        let last = section.tables[2].rows.last().expect("rows");
        assert_eq!(last[5..], ["50.0", "9.0", "25.0"]);
        assert_eq!(section.figures.len(), 2);
    }

    #[test]
    fn cores_that_gave_nothing_where_they_were_held_back_are_told() {
        let section = section(&[study(SUBJECTS[2], 1.5)]).expect("it is drawn");
        let told = &section.findings[2];
        assert_tells(told, "with 1.75 cores, which were held back, it computes only 1.00 times as fast as with 1.50");
    }

    #[test]
    fn work_that_is_not_the_same_at_each_limit_is_told() {
        let mut study = study(SUBJECTS[2], 8.0);
        for (cores, measured) in &mut study.runs {
            if let CachedResult::Done(reading) = measured {
                let more = 1.0 + (1.0 - *cores).max(0.0);
                reading.trace = trace(0.1 * more / *cores);
            }
        }
        let section = section(&[study]).expect("it is drawn");
        let told = &section.findings[0];
        assert_tells(told, "computation is 175 core ms at 0.25 cores and 100 core ms at 1.00");
    }

    #[test]
    fn a_program_of_one_thread_gains_nothing() {
        let section = section(&[study(SUBJECTS[1], 1.0)]).expect("it is drawn");
        assert_tells(&section.findings[2], "more than 1.00 cores are not expected");
        assert_eq!(section.tables[2].rows[0][4], section.tables[2].rows[3][6]);
    }

    #[test]
    fn what_was_not_measured_is_named() {
        let mut study = study(SUBJECTS[2], 8.0);
        for (_, measured) in study.runs.iter_mut().take(2) {
            *measured = CachedResult::Missing("no cgroups".to_owned());
        }
        study.native = CachedResult::Missing("no cgroups".to_owned());
        let section = section(&[study]).expect("it is drawn");
        let missing: Vec<&str> = section.missing.iter().map(|one| one.what.as_str()).collect();
        assert_eq!(missing.len(), 4, "{missing:?}");
        assert!(section.tables[2].rows.is_empty());
    }
}
