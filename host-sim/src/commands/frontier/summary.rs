//! What the runs of each setting have in common, and the setting of each form with the fewest
//! broadcasts within the target.

use serde::Serialize;

use super::forms::{Form, Level, Variant};
use super::points::Point;
use crate::commands::radio::{self, Cost, RADIOS, days};
use crate::commands::seeds::Spread;
use crate::graph::Graph;
use crate::number::significant;
use crate::report::columns::Table;

/// The runs of one setting.
#[derive(Clone, Debug)]
pub(super) struct Setting<'p> {
    pub(super) form: Form,
    pub(super) level: Level,
    pub(super) is_own: bool,
    pub(super) points: &'p [Point],
}

impl<'p> Setting<'p> {
    /// Returns the settings of variants whose runs are all in `points`, in order.
    pub(super) fn all(variants: &[Variant], points: &'p [Point], runs: usize) -> Vec<Self> {
        let settings = variants.iter().zip(points.chunks_exact(runs));
        let setting = |(variant, points): (&Variant, &'p [Point])| Self {
            form: variant.form,
            level: variant.level,
            is_own: variant.is_own,
            points,
        };
        settings.map(setting).collect()
    }

    /// Returns the spread of the largest error of an agent; `None` if a run failed.
    pub(super) fn errors(&self) -> Option<Spread> {
        let errors: Option<Vec<f64>> = self.points.iter().map(Point::largest_error).collect();
        Spread::of(errors?.into_iter())
    }

    /// Returns the spread of a count; `None` if a run failed.
    pub(super) fn counts(&self, of: impl Fn(&Point) -> Option<u64>) -> Option<Spread> {
        let counts: Option<Vec<u64>> = self.points.iter().map(of).collect();
        Spread::of(counts?.into_iter().map(|count| count as f64))
    }

    /// Returns each agent's spread of errors; empty if a run failed.
    fn agents(&self) -> Vec<Spread> {
        let agents = self.points.first().map_or(0, |point| point.rmse.len());
        let of = |agent: usize| {
            let errors: Option<Vec<f64>> =
                self.points.iter().map(|point| point.rmse[agent]).collect();
            Spread::of(errors?.into_iter())
        };
        (0..agents).map_while(of).collect()
    }

    pub(super) fn is_certified(&self) -> bool {
        self.points.iter().all(|point| point.certified)
    }

    /// Whether every agent of every run is within its target.
    fn is_within(&self, target: &[f64]) -> bool {
        self.points.iter().all(|point| {
            point.failure.is_none()
                && point.rmse.iter().zip(target).all(|(e, &most)| e.is_some_and(|e| e <= most))
        })
    }

    /// Returns the median cost on each radio.
    fn costs(&self, graph: &Graph, window: f64) -> Vec<Cost> {
        let mut costs: Vec<Vec<Cost>> = RADIOS.iter().map(|_| Vec::new()).collect();
        for point in self.points {
            for (costs, cost) in
                costs.iter_mut().zip(radio::costs(&radio::nodes(graph, &point.frames), window))
            {
                costs.push(cost);
            }
        }
        let median = |mut costs: Vec<Cost>| {
            costs.sort_by(|a, b| a.channel_share.total_cmp(&b.channel_share));
            costs.get(costs.len() / 2).cloned()
        };
        costs.into_iter().filter_map(median).collect()
    }
}

/// The setting of a form with the fewest broadcasts within the target.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Best {
    form: Form,
    /// Whether there is such a setting; otherwise this is the one with the smallest errors.
    within_target: bool,
    radius: Option<f64>,
    wanted_error: Option<f64>,
    period: Option<f64>,
    runs: usize,
    broadcasts: Spread,
    bytes: Spread,
    /// Of each agent.
    rmse: Vec<Spread>,
    certified: bool,
    /// The largest of all runs.
    bound: Option<f64>,
    radio: Vec<Cost>,
}

/// Returns the best setting of each form that has one without failures.
pub(super) fn best(
    settings: &[Setting<'_>],
    target: &[f64],
    graph: &Graph,
    window: f64,
) -> Vec<Best> {
    let mut forms: Vec<Form> = Vec::new();
    for setting in settings {
        if !forms.contains(&setting.form) {
            forms.push(setting.form);
        }
    }
    let best_of = |form: Form| {
        let complete = || {
            settings.iter().filter_map(move |setting| {
                let (broadcasts, bytes) =
                    (setting.counts(|p| p.broadcasts)?, setting.counts(|p| p.bytes)?);
                (setting.form == form).then_some((setting, broadcasts, bytes, setting.errors()?))
            })
        };
        let within = complete()
            .filter(|(setting, ..)| setting.is_within(target))
            .min_by(|a, b| a.1.median.total_cmp(&b.1.median));
        let within_target = within.is_some();
        let (setting, broadcasts, bytes, _) =
            within.or_else(|| complete().min_by(|a, b| a.3.max.total_cmp(&b.3.max)))?;
        let level = |of: fn(Level) -> Option<f64>| of(setting.level);
        Some(Best {
            form,
            within_target,
            radius: level(|level| match level {
                Level::Radius(radius) => Some(radius),
                _ => None,
            }),
            wanted_error: level(|level| match level {
                Level::Error(error) => Some(error),
                _ => None,
            }),
            period: level(|level| match level {
                Level::Period(period) => Some(period),
                _ => None,
            }),
            runs: setting.points.len(),
            broadcasts,
            bytes,
            rmse: setting.agents(),
            certified: setting.is_certified(),
            bound: setting.points.iter().filter_map(|point| point.bound).reduce(f64::max),
            radio: setting.costs(graph, window),
        })
    };
    forms.into_iter().filter_map(best_of).collect()
}

/// Up to this many agents have columns of their own.
const COLUMNS: usize = 4;

/// Returns a table of the best settings for this many agents.
pub(super) fn table(best: &[Best], agents: usize) -> Table {
    let errors: Vec<String> = match agents {
        0..=COLUMNS => (1..=agents).map(|agent| format!("agent {agent}")).collect(),
        _ => vec!["largest".to_owned()],
    };
    let mut headings: Vec<[&str; 2]> = vec![
        ["", "form"],
        ["", "setting"],
        ["broadcasts", "median"],
        ["broadcasts", "worst"],
        ["bytes", "median"],
        ["bytes", "worst"],
    ];
    headings.extend(errors.iter().map(|agent| ["RMSE, median", agent.as_str()]));
    headings.extend(errors.iter().map(|agent| ["RMSE, worst", agent.as_str()]));
    headings.push(["", "bound"]);
    let row = |best: &Best| {
        let whole = |value: f64| format!("{value:.0}");
        let mark = if best.within_target { "" } else { "*" };
        let mut row = vec![format!("{}{mark}", best.form.name()), setting_in_words(best)];
        for spread in [best.broadcasts, best.bytes] {
            row.extend([whole(spread.median), whole(spread.max)]);
        }
        let shown = |of: fn(&Spread) -> f64| -> Vec<f64> {
            let all = best.rmse.iter().map(of);
            if agents <= COLUMNS {
                all.collect()
            } else {
                all.reduce(f64::max).into_iter().collect()
            }
        };
        let number = |value: &f64| significant(*value, 3);
        row.extend(shown(|spread| spread.median).iter().map(number));
        row.extend(shown(|spread| spread.max).iter().map(number));
        let bound = best.bound.filter(|_| best.certified);
        row.push(bound.map_or("-".to_owned(), |bound| significant(bound, 3)));
        row
    };
    Table::new(&headings, best.iter().map(row).collect())
}

/// Formats the best settings and what they cost on radios.
pub(super) fn text(best: &[Best], target: &[f64], target_label: &str) -> String {
    if target.is_empty() {
        return String::new();
    }
    let smallest = target.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = target.iter().copied().fold(0.0, f64::max);
    let range = match smallest < largest {
        true => format!("{} to {}", significant(smallest, 3), significant(largest, 3)),
        false => significant(largest, 3),
    };
    let mut text = format!(
        "Fewest broadcasts with every agent of every run within {target_label} ({range})\n\n{}",
        table(best, target.len()).text()
    );
    if best.iter().any(|best| !best.within_target) {
        text += "* no setting is within the target; the one with the smallest errors\n";
    }
    text += "bound: certified for |e_1| of all agents together; - without a certificate\n\n";
    text + &radio_text(best)
}

fn setting_in_words(best: &Best) -> String {
    match (best.radius, best.wanted_error, best.period) {
        (Some(radius), ..) => format!("r = {}", significant(radius, 2)),
        (_, Some(error), _) => format!("error = {}", significant(error, 2)),
        (_, _, Some(period)) => format!("{} ms", significant(1e3 * period, 3)),
        _ => String::new(),
    }
}

/// Returns a table of what the best settings cost on radios.
pub(super) fn radio_table(best: &[Best]) -> Table {
    let mut headings = vec![["", "form"]];
    for radio in &RADIOS {
        headings.extend(["air [%]", "CR2032 [d]", "2 AA [d]"].map(|name| [radio.name, name]));
    }
    let row = |best: &Best| {
        let mut row = vec![best.form.name().to_owned()];
        for cost in &best.radio {
            row.push(significant(100.0 * cost.channel_share, 2));
            row.extend([days(cost.life_cr2032_days), days(cost.life_2_aa_days)]);
        }
        row
    };
    Table::new(&headings, best.iter().map(row).collect())
}

fn radio_text(best: &[Best]) -> String {
    format!(
        "Radio: the channel's time taken by all agents, and the days that a battery of the busiest node lasts \
         if it\npowers nothing but sending its frames and hearing those of its neighbours; - if the channel is \
         too slow\n\n{}\n",
        radio_table(best).text()
    )
}
