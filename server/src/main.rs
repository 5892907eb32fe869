//! The environment server's binary.

fn main() {}
