//! Recorded and simulated episodes on disk and in memory.
