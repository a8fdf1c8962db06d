//! What is certified of a run with the field observer.

use serde::Serialize;

use agent_core::observer::field::Coupling;

use crate::commands::certified;
use crate::engine::RunResult;
use crate::number::significant;
use crate::scenario::Scenario;

/// The certificate, or why there is none.
#[derive(Debug, Serialize)]
pub(super) struct ObserverCertificate {
    certified: bool,
    /// Bound on `|e_1|`, all agents stacked, after a long time. \[state unit\]
    bound: Option<f64>,
    /// Why nothing is certified.
    reasons: Vec<String>,
}

impl ObserverCertificate {
    /// `None` for the paper's observer, which the theorems' checks cover.
    pub(super) fn new(scenario: &Scenario, result: &RunResult) -> Option<Self> {
        let observer = scenario.observer.as_ref()?;
        let bound = certified::bound(scenario, result);
        let mut reasons = Vec::new();
        if bound.is_none() {
            reasons.extend(
                scenario.trigger.departure().map(|when| format!("agents broadcast {when}")),
            );
            let departures = scenario.departures().into_iter().map(str::to_owned);
            reasons.extend(departures.filter(|clause| !clause.contains("[observer]")));
            if observer.exchange.is_some() {
                reasons.push(
                    "the preset \"robust\" sets gaps, repetitions and a heartbeat".to_owned(),
                );
            }
            if observer.coupling == Coupling::Current {
                reasons.push("the certificate of current estimates is not computed".to_owned());
            }
            if reasons.is_empty() {
                reasons.push("its inequality does not hold for these gains".to_owned());
            }
        }
        Some(Self { certified: bound.is_some(), bound, reasons })
    }

    pub(super) fn text(&self) -> String {
        match self.bound {
            Some(bound) => format!(
                "Field observer: certified; after a long time |e_1| of all agents together stays below {} \
                 (docs/field-observer.md)\n",
                significant(bound, 3)
            ),
            None => format!("Field observer: nothing is certified: {}\n", self.reasons.join("; ")),
        }
    }
}
