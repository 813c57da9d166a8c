//! Background work: its table, its legal state transitions, its runner.
