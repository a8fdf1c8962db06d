//! The digests that every processor must compute.
//!
//! The first run on an x86-64 host printed these numbers; after an intended change of results, the
//! failure of `cargo test -p on-target` prints the new ones.

/// Every section with its digest, in execution order.
pub const DIGESTS: [(&str, u64); 6] = [
    ("activations", 0x4d98_62c8_32f1_0227),
    ("network", 0xdd77_0492_c179_ad7b),
    ("agent", 0xdfbc_5faa_9bff_4763),
    ("package", 0x8d27_7e89_6dbc_cdaa),
    ("keys", 0xd397_d99a_3c92_6f35),
    ("turn", 0x9e3e_4240_e3ec_8524),
];
