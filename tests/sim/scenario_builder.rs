//! Builds small scenarios as TOML text, which the loader then reads.

use std::fmt::Write;

use host_sim::scenario::Scenario;

/// A scenario of slow oscillators that agents observe; every part can be replaced.
#[derive(Clone, Debug)]
pub(crate) struct Described {
    /// Tables `[plant]` and, optionally, `[disturbance]`.
    pub(crate) plant: String,
    /// \[s\]
    pub(crate) duration: f64,
    pub(crate) integrator: &'static str,
    /// `K_1` as a multiple of the identity. \[1/s\]
    pub(crate) gain: f64,
    pub(crate) epsilon: f64,
    /// Tables `[network]` and `[outer_law]`; empty for feedback alone.
    pub(crate) network: String,
    /// Table `[graph]`; empty for one agent.
    pub(crate) graph: String,
    /// Rows of `C_i` and the number of such agents.
    pub(crate) agents: Vec<(Vec<Vec<f64>>, usize)>,
    /// Tables `[[learning]]` and `[recipes.*]`.
    pub(crate) learning: String,
    pub(crate) trace_stride: u32,
    pub(crate) events: bool,
}

impl Described {
    /// Oscillators of `n` components, and agents with these output matrices on a topology; a step
    /// of 1 ms.
    pub(crate) fn linear(
        n: usize,
        topology: &str,
        agents: impl IntoIterator<Item = (Vec<Vec<f64>>, usize)>,
    ) -> Self {
        Self {
            plant: oscillators(n),
            duration: 3.0,
            integrator: "euler",
            gain: 60.0,
            epsilon: 50.0,
            network: String::new(),
            graph: format!("[graph]\ntopology = \"{topology}\"\n"),
            agents: agents.into_iter().collect(),
            learning: String::new(),
            trace_stride: 1,
            events: true,
        }
    }

    /// Returns the TOML text.
    pub(crate) fn text(&self) -> String {
        let mut text = format!(
            "name = \"scenario_builder\"\n{}\n[time]\nduration = {:?}\nstep = 0.001\n\
             plant_integrator = \"{}\"\n\n[design]\ngain = {:?}\nk2 = 5.0\nkappa = 1.0\n\
             rho = 1.0\ndelta = 0.5\nepsilon = {:?}\n\n{}\n{}\n[record]\ntrace_stride = {}\n\
             events = {}\n",
            self.plant,
            self.duration,
            self.integrator,
            self.gain,
            self.epsilon,
            self.network,
            self.graph,
            self.trace_stride,
            self.events,
        );
        for (rows, count) in &self.agents {
            // Writing into a string cannot fail.
            let _ = write!(text, "\n[[agents]]\noutput_matrix = {rows:?}\ncount = {count}\n");
        }
        text + &self.learning
    }

    /// Returns the scenario.
    pub(crate) fn scenario(&self) -> Scenario {
        let text = self.text();
        Scenario::parse("scenario_builder.toml", &text)
            .unwrap_or_else(|error| panic!("{error}\n{text}"))
    }
}

/// Table `[plant]`: `x' = A x` with pairs of components that rotate at 0.3 rad/s and
/// more, each pair a little faster, and decay at 0.02/s; a last component without a partner
/// only decays. All start at 1.
fn oscillators(n: usize) -> String {
    let row = |row: usize| {
        let mut entries = vec![0.0; n];
        entries[row] = -0.02;
        let (partner, sign) = if row.is_multiple_of(2) { (row + 1, -1.0) } else { (row - 1, 1.0) };
        if partner < n {
            entries[partner] = sign * (0.3 + 0.05 * (row / 2) as f64);
        }
        entries
    };
    let matrix: Vec<_> = (0..n).map(row).collect();
    let start = vec![1.0; n];
    format!(
        "[plant]\nmodel = \"linear\"\nparameters = {{ matrix = {matrix:?} }}\n\
         initial_state = {start:?}\n"
    )
}

/// Returns the `C_i` that measures these components (from 0) of `n`.
pub(crate) fn picks(n: usize, components: impl IntoIterator<Item = usize>) -> Vec<Vec<f64>> {
    let row = |picked| (0..n).map(|component| f64::from(u8::from(component == picked))).collect();
    components.into_iter().map(row).collect()
}

/// Tables `[network]` and `[outer_law]`: layers with these widths and activations, random
/// inner parameters, small outer weights.
pub(crate) fn network(layers: &[(u8, &str)], outer_gain: &str) -> String {
    let layers: Vec<_> = layers
        .iter()
        .map(|(nodes, activation)| format!("{{ nodes = {nodes}, activation = \"{activation}\" }}"))
        .collect();
    format!(
        "[network]\nlayers = [{}]\ninner = {{ random = \"glorot\" }}\nouter = {{ random = 0.05 }}\n\n\
         [outer_law]\ngain = {outer_gain}\nbound = 20.0\n",
        layers.join(", ")
    )
}

/// A learning cycle of these agents (from 1), by the recipe `short`.
pub(crate) fn cycle(agents: &[usize], from: f64, to: f64, apply_at: f64) -> String {
    format!(
        "\n[[learning]]\nagents = {agents:?}\ncollect_from = {from:?}\ncollect_to = {to:?}\n\
         apply_at = {apply_at:?}\nrecipe = \"short\"\n"
    )
}

/// A recipe of a few epochs whose network is always used.
pub(crate) const SHORT_RECIPE: &str = "\n[recipes.short]\nsmoothing_window = 0.1\n\
                                      decimation = 5\nepochs = 10\nswitch_in = \"always\"\n";
