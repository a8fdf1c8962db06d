//! The design as text, and in the text of a scenario.

use toml_edit::{Array, DocumentMut, Item, Value};

use super::frontier;
use super::{Designed, rows};
use crate::number::significant;
use crate::report::checks;
use crate::scenario::Scenario;

/// Formats the report.
pub(super) fn of(scenario: &Scenario, designed: &Designed) -> String {
    let Designed { gain, step, certificate, knee, frontier: points, checks, .. } = designed;
    let shown = |x: f64| significant(x, 6);
    let step_max = step.largest_stable_step.map_or("none".to_owned(), |step| significant(step, 4));
    let mut text = format!("Design of scenario {}\n", scenario.name);
    if !scenario.uses_design_gain() {
        text += "  for the paper's observer; with [observer] from the start, or a Kalman filter, agents use none of these numbers\n";
    }
    text += &format!(
        "  gain = {}\n\
        \x20 trace {} 1/s, norm {} 1/s, within {} of the optimum\n\
        \x20 lambda_min = {} 1/s (+- {}), checked independently of the solver\n\
        \x20 largest stable step {step_max} s\n\
        \x20 rho = {}, from chi_bar_max of the confirming run\n\
        \x20 k1 = {} 1/s, k2 = {} 1/s, kappa = {} s, delta = {}, epsilon = {}\n\
        \x20 phi1 = {} 1/s, phi2 = {} 1/s: the trigger's radius is {}\n\
        \x20 Theorem 1: ultimate bound |e_1| <= {} without the weight error{}\n\
        \x20 knee: a radius below {} (epsilon {}) lowers that bound, there {}, by at most 29 %\n\n",
        gain_text(designed),
        shown(gain.trace()),
        shown(gain.norm()),
        significant(gain.gap, 1),
        significant(gain.certificate.eigenvalue_min, 9),
        significant(gain.certificate.uncertainty, 1),
        certificate.rho,
        shown(certificate.k1),
        certificate.k2,
        certificate.kappa,
        certificate.delta,
        certificate.epsilon,
        shown(certificate.phi1),
        shown(certificate.phi2),
        shown(certificate.radius),
        significant(certificate.bound, 4),
        checks.design.ultimate_bound.map_or(String::new(), |bound| format!(
            ", {} with it",
            significant(bound.ultimate().sqrt(), 4)
        )),
        significant(knee.radius, 3),
        significant(knee.epsilon, 3),
        significant(knee.bound, 3),
    );
    if let (Some(error), true) = (designed.error, designed.state_deviation > 0.0) {
        text += &format!(
            "Confirming run: largest RMSE {}, {} % of the state's RMS distance from its mean, {}; {} broadcasts per agent \
             per second, {} % of the steps\n\n",
            significant(error, 3),
            significant(100.0 * error / designed.state_deviation, 3),
            significant(designed.state_deviation, 3),
            significant(designed.rate, 3),
            significant(100.0 * designed.rate * scenario.time.step_size, 3),
        );
    }
    if !points.is_empty() {
        text += &frontier::table(points);
        text.push('\n');
    }
    text + &checks::text(checks)
}

/// Formats the gain as a scenario has it: a diagonal, or rows.
fn gain_text(designed: &Designed) -> String {
    gain_value(designed).to_string()
}

fn gain_value(designed: &Designed) -> Value {
    let gain = &designed.gain.gain;
    let is_diagonal = (0..gain.nrows()).all(|i| (0..i).all(|j| gain[(i, j)] == 0.0));
    if is_diagonal {
        gain.diagonal().iter().copied().collect::<Array>().into()
    } else {
        let rows = rows(&designed.gain).into_iter();
        rows.map(|row| Value::from(row.into_iter().collect::<Array>())).collect::<Array>().into()
    }
}

/// Returns the scenario's text with the chosen numbers in `[design]`; `None` without such a table.
pub(super) fn edited(source: &str, designed: &Designed) -> Option<String> {
    let mut document: DocumentMut = source.parse().ok()?;
    let table = document.get_mut("design")?.as_table_like_mut()?;
    let certificate = &designed.certificate;
    let mut replace = |key: &str, mut value: Value| -> Option<()> {
        let item = table.get_mut(key)?;
        // Blanks and the comment after the value; a table, such as a scaled gain, has none.
        if let Some(old) = item.as_value() {
            *value.decor_mut() = old.decor().clone();
        }
        *item = Item::Value(value);
        Some(())
    };
    replace("gain", gain_value(designed))?;
    replace("k2", certificate.k2.into())?;
    replace("kappa", certificate.kappa.into())?;
    replace("rho", certificate.rho.into())?;
    replace("delta", certificate.delta.into())?;
    replace("epsilon", certificate.epsilon.into())?;
    Some(document.to_string())
}
