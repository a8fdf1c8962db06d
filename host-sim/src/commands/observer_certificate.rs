//! What the certificate says about the field observer, for a finished run and before a run.

use serde::Serialize;

use crate::engine::{RunError, TrainingRecord};
use crate::flow::Plan;
use crate::number::significant;
use crate::packages::facts::Observer;
use crate::scenario::{Method, Scenario};

use super::certified;

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
    /// Returns what is certified with the network in use after these training runs; `None` for the paper's observer,
    /// which the theorems' checks cover.
    pub(super) fn new(scenario: &Scenario, trainings: &[TrainingRecord]) -> Option<Self> {
        scenario.observer.as_ref()?;
        Some(match certified::bound(scenario, trainings) {
            Ok(bound) => Self { certified: true, bound: Some(bound), reasons: Vec::new() },
            Err(reasons) => Self { certified: false, bound: None, reasons },
        })
    }

    pub(super) fn text(&self) -> String {
        format!("Field observer: {}\n", self.words())
    }

    fn words(&self) -> String {
        match self.bound {
            Some(bound) => format!(
                "certified; after a long time |e_1| of all agents together stays below {} (docs/field-observer.md)",
                significant(bound, 3)
            ),
            None => format!("nothing is certified: {}", self.reasons.join("; ")),
        }
    }
}

/// What is known of the field observer before a run.
#[derive(Debug, Serialize)]
pub(super) struct ObserverPreview {
    /// When agents switch to it. \[s\]
    from: f64,
    /// Whether a run trains a network, for which the settings are derived again.
    trained_later: bool,
    /// The requested error, if settings follow from it. \[standard deviation\]
    derived_from_error: Option<f64>,
    /// Those of agent 1 with the network that it starts with.
    settings: Observer,
    #[serde(flatten)]
    certificate: ObserverCertificate,
}

impl ObserverPreview {
    /// Returns `None` for the paper's observer, and for methods with something in place of the network.
    ///
    /// # Errors
    /// The error with which a run ends, because the observer cannot be set up.
    pub(super) fn new(scenario: &Scenario) -> Result<Option<Self>, RunError> {
        let is_observer =
            matches!(scenario.method, Method::Observer | Method::NoNetwork | Method::Untrained);
        let Some(observer) = scenario.observer.as_ref().filter(|_| is_observer) else {
            return Ok(None);
        };
        let Some(plan) = Plan::new(scenario).map_err(RunError::Observer)? else { return Ok(None) };
        let package = certified::equipped(scenario, &plan, &[])
            .ok_or(RunError::ObserverWithoutNetwork)?
            .map_err(RunError::Observer)?;
        let settings = Observer::new(&package.package().node, scenario.dimension());
        let certificate = ObserverCertificate::new(scenario, &[]);
        let (Some(settings), Some(certificate)) = (settings, certificate) else { return Ok(None) };
        let learns = scenario.method == Method::Observer && !scenario.learning.is_empty();
        let trained_later = observer.network && learns;
        let derived_from_error = (!observer.is_complete()).then_some(observer.error);
        let from = observer.from;
        Ok(Some(Self { from, trained_later, derived_from_error, settings, certificate }))
    }

    pub(super) fn text(&self) -> String {
        let source = match self.derived_from_error {
            Some(error) => format!(
                "what the scenario leaves out is derived from observer.error = {error} and the plant's trajectory"
            ),
            None => "as the scenario sets them".to_owned(),
        };
        let mut text = format!("  Field observer from t = {} s, {source}:\n", self.from);
        text.extend(self.settings.shared_words().map(|line| format!("    {line}\n")));
        text += &format!("    {}\n", self.certificate.words());
        if self.trained_later {
            text += "    This is without a trained network. A run derives it again from the network that it trains: `run` prints \
                     the certificate, and `weights inspect` the settings in its packages.\n";
        }
        text
    }
}
