//! The thread that owns the models, and the handle that async code asks.
