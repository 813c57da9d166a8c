//! Training and evaluation of Foreframe's models. Use it through the crate `foreframe`.

mod frame_marks;

pub mod settings;

pub mod training;

pub mod evaluation;

pub mod adaptation;
