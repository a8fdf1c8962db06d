//! A node's samples, for training.
