//! Shows any artifact.
fn main() {}
