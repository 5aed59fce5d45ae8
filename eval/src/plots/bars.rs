//! Grouped bar charts.

use super::Bar;
use super::axis::{Axis, three_digits};
use super::canvas::{
    Anchor, HEIGHT, LegendSymbol, PlotHeader, PlotMargins, SCALE, TEXT, WIDTH, chart, colour, document, draw_line,
    empty_plot, entries, omission_note, text_width, wrap, write_text,
};
use anyhow::Result;
use plotters::prelude::*;

/// Fraction of a group's width that its bars fill.
const FILLED: f64 = 0.84;
/// Font size of the value above a bar, in shown pixels.
const VALUE: i32 = 11;
/// Minimum width of a bar, in shown pixels.
const NARROW: i32 = 20;
/// Maximum width of a bar, in shown pixels.
const WIDE: f64 = 72.0;
const LINE: i32 = TEXT + 3;
const WHISKER: RGBColor = RGBColor(0x22, 0x22, 0x22);

/// Bars of one group, each with the index of its name.
struct BarGroup<'a> {
    name: &'a str,
    bars: Vec<(usize, &'a Bar)>,
}

/// Draws grouped bars with whiskers and values. `name` is the label of the axis, with its unit.
pub fn bars(title: &str, name: &str, bars: &[Bar], log: bool) -> Result<String> {
    // A zero has no height on a logarithmic axis, but its value is known and written.
    let known: Vec<&Bar> = bars.iter().filter(|bar| Axis::for_values([bar.value], false).is_some()).collect();
    let omitted = bars.len() - known.len();
    let log = log && known.iter().any(|bar| bar.value > 0.0);
    let ends = known.iter().flat_map(|bar| {
        let spread = bar.spread.unwrap_or((bar.value, bar.value));
        [bar.value, spread.0, spread.1]
    });
    let Some(y) = Axis::for_values(ends, log) else {
        return empty_plot(title, omitted);
    };
    let (names, groups) = group_bars(&known);
    let most = groups.iter().map(|group| group.bars.len()).max();
    let most = most.unwrap_or(1) as f64;

    let longest = groups.iter().flat_map(|group| group.name.split_whitespace()).map(|word| word.chars().count()).max();
    let least = text_width(longest.unwrap_or(0), TEXT) + 10;
    let least = least.max((f64::from(NARROW) * most / FILLED) as i32) as u32;
    let left = PlotMargins::for_axis(&y).left;
    let width = WIDTH.max(least * groups.len() as u32 + left + 24);
    let group_width = f64::from(width - left - 24) / groups.len() as f64;
    let bar_width = (group_width * FILLED / most).min(WIDE);

    let values = known.iter().map(|bar| three_digits(bar.value).chars().count());
    let longest = text_width(values.max().unwrap_or(0), VALUE);
    let upwards = f64::from(longest) > bar_width * 1.12;
    let above = if upwards { longest + 8 } else { VALUE + 8 };
    let room = f64::from(above) / f64::from(HEIGHT - 110);
    let y = y.with_zero().with_room(room);

    let letters = (group_width - 8.0) / text_width(10, TEXT) as f64 * 10.0;
    let labels: Vec<Vec<String>> = groups.iter().map(|group| wrap(group.name, letters as usize)).collect();
    let lines = labels.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let below = 12 + LINE as u32 * lines;

    let head = PlotHeader::new(title, entries(names, LegendSymbol::Patch), width);
    document(&head, (width, HEIGHT - 48 + below), omission_note(omitted), |area| {
        let rows = (head.height, head.height + HEIGHT - 48);
        let mut x = Axis::with_bounds(0.0, groups.len() as f64);
        x.marks.clear();
        let sides = PlotMargins { left, right: 24, below: false };
        let chart = chart(area, rows, &sides, (&x, ""), (&y, name))?;
        let at = |x: f64, y: f64| chart.backend_coord(&(x, y));
        let bottom = if log { y.low } else { 0.0f64.clamp(y.low, y.high) };
        let half = bar_width / group_width / 2.0;
        for (index, group) in groups.iter().enumerate() {
            let middle = index as f64 + 0.5;
            for (place, (of_name, bar)) in group.bars.iter().enumerate() {
                let x = middle + (2.0 * place as f64 + 1.0 - group.bars.len() as f64) * half;
                let height = y.position(bar.value).unwrap_or(bottom);
                let (from, to) = (at(x - half * 0.92, height), at(x + half * 0.92, bottom));
                area.draw(&Rectangle::new([from, to], colour(*of_name).filled()))?;
                let (centre, mut top) = (at(x, height).0, from.1.min(to.1));
                if let Some((low, high)) = bar.spread {
                    let ends = (y.position(low), y.position(high));
                    // On a logarithmic axis a whisker down to zero starts at the bottom.
                    let low_end = ends.0.or((log && low <= 0.0).then_some(y.low));
                    if let (Some(low), Some(high)) = (low_end, ends.1) {
                        let (low, high) = (at(x, low).1, at(x, high).1);
                        let wide = (bar_width * 0.18) as i32 * SCALE;
                        draw_line(area, &[(centre, low), (centre, high)], WHISKER, 1)?;
                        for end in [low, high] {
                            let cap = [(centre - wide, end), (centre + wide, end)];
                            draw_line(area, &cap, WHISKER, 1)?;
                        }
                        top = top.min(high);
                    }
                }
                let (anchor, gap) = if upwards { (Anchor::Upwards, 4) } else { (Anchor::Above, 1) };
                let place = (centre, top - gap * SCALE);
                write_text(area, &three_digits(bar.value), place, VALUE, anchor)?;
            }
        }
        let (_, base) = at(0.0, y.low);
        for (index, lines) in labels.iter().enumerate() {
            let centre = at(index as f64 + 0.5, y.low).0;
            for (line, text) in lines.iter().enumerate() {
                let below = base + (8 + LINE * line as i32) * SCALE;
                write_text(area, text, (centre, below), TEXT, Anchor::Below)?;
            }
        }
        Ok(())
    })
}

/// Returns names and groups in the order of first occurrence.
fn group_bars<'a>(bars: &[&'a Bar]) -> (Vec<&'a str>, Vec<BarGroup<'a>>) {
    let mut names: Vec<&str> = Vec::new();
    let mut groups: Vec<BarGroup> = Vec::new();
    for bar in bars {
        let known = names.iter().position(|name| *name == bar.name);
        let index = known.unwrap_or_else(|| {
            names.push(&bar.name);
            names.len() - 1
        });
        match groups.iter_mut().find(|group| group.name == bar.group) {
            Some(group) => group.bars.push((index, bar)),
            None => groups.push(BarGroup { name: &bar.group, bars: vec![(index, bar)] }),
        }
    }
    (names, groups)
}
