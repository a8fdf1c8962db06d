//! Benchmarks one evaluation of the inner network of the paper's size, 425 parameters, with each
//! activation.

use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use divan::Bencher;

fn main() {
    divan::main();
}

fn network(activation: Activation) -> InnerNetwork<Vec<f32>> {
    let layers = [12, 12, 12, 5].map(|width| Layer { width, activation });
    let architecture = Architecture::new(3, &layers).expect("the architecture is valid");
    // Any weights that do not saturate the nodes are suitable.
    let parameters = 0..architecture.parameter_count();
    let parameters = parameters.map(|i| ((i * 37 % 101) as f32 - 50.0) / 100.0).collect();
    InnerNetwork::new(architecture, parameters).expect("the parameters are finite")
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
