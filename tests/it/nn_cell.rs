//! The LSTM cell against onnxruntime's `LSTM` operator with peepholes (`tests/fixtures/lstm_peephole.py`).

use std::collections::HashMap;

use candle_core::{Device, Tensor};
use foreframe_core::nn::dense::{LstmState, PeepholeCell, unroll};

use crate::nn_fixtures::largest_difference;
use crate::nn_reference::{CellState, step};

type Tensors = HashMap<String, Tensor>;

fn fixture() -> Tensors {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/lstm_peephole.safetensors");
    candle_core::safetensors::load(path, &Device::Cpu).unwrap()
}

fn cell(t: &Tensors) -> PeepholeCell {
    let peepholes = ["i", "f", "o"].map(|gate| t[&format!("peephole_{gate}")].clone());
    PeepholeCell::new(t["w_x"].clone(), t["w_h"].clone(), t["bias"].clone(), peepholes)
}

fn start(t: &Tensors) -> LstmState {
    LstmState {
        h: t["h0"].clone(),
        c: t["c0"].clone(),
    }
}

#[test]
fn twelve_steps_of_the_reference_agree_with_onnxruntime() {
    let t = fixture();
    let LstmState { h, c } = start(&t);
    let mut state = CellState { h, c };
    assert_eq!(t["h"].dim(1).unwrap(), 12);
    for k in 0..12 {
        state = step(|name| &t[name], &t["x"].get_on_dim(1, k).unwrap(), &state).unwrap();
        let expected = t["h"].get_on_dim(1, k).unwrap();
        assert!(largest_difference(&state.h, &expected) < 1e-5, "step {k}");
    }
    assert!(largest_difference(&state.c, &t["c"]) < 1e-5);
}

#[test]
fn the_fused_sequence_agrees_with_onnxruntime() {
    let t = fixture();
    let (outputs, state) = unroll(&cell(&t), &t["x"], &start(&t)).unwrap();
    assert!(largest_difference(&outputs, &t["h"]) < 1e-5);
    assert!(largest_difference(&state.c, &t["c"]) < 1e-5);
}

/// The paper's prose lets the output gate see c(t − 1); its equation (4), and Graves, c(t).
#[test]
fn an_output_gate_that_sees_the_previous_memory_differs() {
    let t = fixture();
    let hidden = t["c0"].dim(1).unwrap();
    let sigmoid = |sum: &Tensor| candle_nn::ops::sigmoid(sum).unwrap();
    let x = t["x"].get_on_dim(1, 0).unwrap();
    let sums = x.matmul(&t["w_x"]).unwrap() + t["h0"].matmul(&t["w_h"]).unwrap();
    let sums = sums.unwrap().broadcast_add(&t["bias"]).unwrap();
    let gate = |index: usize| sums.narrow(1, index * hidden, hidden).unwrap();
    let seen = |name: &str| t["c0"].broadcast_mul(&t[name]).unwrap();
    let i = sigmoid(&(gate(0) + seen("peephole_i")).unwrap());
    let f = sigmoid(&(gate(1) + seen("peephole_f")).unwrap());
    let c = ((f * &t["c0"]).unwrap() + (i * gate(2).tanh().unwrap()).unwrap()).unwrap();
    let o = sigmoid(&(gate(3) + seen("peephole_o")).unwrap());
    let h = (o * c.tanh().unwrap()).unwrap();
    assert!(largest_difference(&h, &t["h"].get_on_dim(1, 0).unwrap()) > 1e-2);
}
