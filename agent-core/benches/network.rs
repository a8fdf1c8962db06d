//! The inner network of the paper's size: one evaluation, 425 parameters, and the same with
//! other activations.

use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use divan::Bencher;

fn main() {
    divan::main();
}

fn network(activation: Activation) -> InnerNetwork<Vec<f32>> {
    let layers = [12, 12, 12, 5].map(|width| Layer { width, activation });
    let architecture = Architecture::new(3, &layers).expect("an architecture");
    // Any weights will do, as long as nodes do not saturate.
    let parameters = 0..architecture.parameter_count();
    let parameters = parameters.map(|i| ((i * 37 % 101) as f32 - 50.0) / 100.0).collect();
    InnerNetwork::new(architecture, parameters).expect("finite parameters")
}

#[divan::bench(args = [Activation::Tanh, Activation::Logistic, Activation::Gaussian])]
fn forward_pass(bencher: Bencher, activation: Activation) {
    let network = network(activation);
    let mut scratch = Scratch::NEW;
    let x = [1.5, -0.5, 0.25];
    bencher.bench_local(|| {
        let features = network.features(divan::black_box(&x), &mut scratch);
        features.map(|features| features[0])
    });
}
