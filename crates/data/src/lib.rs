//! Data sets of Foreframe: collection in the simulator, import, export and inspection. Use it through the crate `foreframe`.

pub mod motion;

pub mod protobuf;

pub mod dataset;

pub mod inspection;
