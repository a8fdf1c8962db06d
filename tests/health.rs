//! scratch
use crate::watched_ring::Ring;
use agent_core::health::HealthSettings;
use std::num::NonZeroU32;

#[test]
fn measure() {
    for (name, restart) in [("none", None), ("restart", NonZeroU32::new(1))] {
        for y in [1e2f32, 1e3, 1e4, 1e6, 1e12, 1e30, 3e38] {
            for duration in [1u64, 500] {
                let settings = HealthSettings {
                    fall_back: None,
                    plausible_margin: 10.0,
                    restart_after: restart,
                    telemetry_interval: 100,
                };
                for seed in [1, 2] {
                    let mut ring = Ring::new(seed, &settings);
                    let mut calm = Ring::new(seed, &settings);
                    ring.guarded = restart.is_some();
                    for _ in 0..3000 {
                        ring.step(|_, _| ());
                        calm.step(|_, _| ());
                    }
                    for _ in 0..duration {
                        ring.step(|i, m| {
                            if i == 0 {
                                *m = y
                            }
                        });
                        calm.step(|_, _| ());
                    }
                    let mut back = None;
                    let end = ring.tick;
                    let mut levels = vec![];
                    for _ in 0..10 {
                        for _ in 0..1000 {
                            ring.step(|_, _| ());
                            calm.step(|_, _| ());
                            let worst = (0..3).map(|a| ring.error(a) / 1.0).fold(0.0, f64::max);
                            if worst > 0.5 {
                                back = None
                            } else if back.is_none() {
                                back = Some(ring.tick - end)
                            }
                        }
                        levels.push((ring.error(0), calm.error(0)));
                    }
                    println!(
                        "{name} y={y:e} x{duration} seed {seed}: back after {back:?}; errors at 1,3,10 s {:.3?} {:.3?} {:.3?}; |W|^2 {} restarts {:?}",
                        levels[0],
                        levels[2],
                        levels[9],
                        ring.agents[0].state.outer_weights().norm_squared(),
                        ring.agents
                            .iter()
                            .map(|a| a.health.counters().restarts)
                            .collect::<Vec<_>>()
                    );
                }
            }
        }
    }
}
