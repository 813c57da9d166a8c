//! The simulated two-robot world: seeded, fixed step, no I/O.
