//! The board border.
