//! What every processor has to compute.
//!
//! The first run on an x86-64 host printed these numbers; an intended change of results prints
//! the new ones in the failure of `cargo test -p on-target`.

/// Every section with its digest, in the order in which they run.
pub const DIGESTS: [(&str, u64); 5] = [
    ("activations", 0x4d98_62c8_32f1_0227),
    ("network", 0xdd77_0492_c179_ad7b),
    ("agent", 0xdfbc_5faa_9bff_4763),
    ("package", 0xf9c5_a18e_ac01_9224),
    ("turn", 0x9e3e_4240_e3ec_8524),
];
