//! From a model and a data set to a report that can be trusted.
