//! The sprite network: what it predicts, what it learns from, and what it refuses.

use candle_core::{Device, Tensor};
use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::nn::precision::Precision;
use foreframe_core::nn::sprites::motion_loss;
use foreframe_core::nn::{
    Architecture, ChannelScale, Conditioning, ConditioningTensors, Loss, ModelSpec, Network, Parameters, SpriteSpec,
};
use foreframe_core::types::Seed;

use crate::nn_fixtures::{largest_difference, values};

const SIDE: usize = 32;

fn spec() -> ModelSpec {
    ModelSpec {
        architecture: Architecture::Sprites(SpriteSpec {
            channels: 8,
            stem_channels: 6,
            encoder_blocks: 2,
            enlarged_channels: 4,
            fine_channels: 6,
            content_channels: 6,
            motion_hidden: 16,
            motion_memory: 4,
        }),
        frame_width_px: SIDE as u32,
        frame_height_px: SIDE as u32,
        preprocess: Preprocess {
            blur_sigma_px: 0.0,
            invert: false,
        },
        context: 4,
        horizon: 3,
        ..ModelSpec::default()
    }
}

/// Frames `[1, count, P]` of squares of 6×6 px, each from its first place (column, row) on at its own speed.
fn squares(squares: &[([i32; 2], [i32; 2])], count: usize) -> Tensor {
    let mut frames = vec![0.0f32; count * SIDE * SIDE];
    for (frame, pixels) in frames.chunks_exact_mut(SIDE * SIDE).enumerate() {
        for ([left, top], [right, down]) in squares {
            for place in 0..36 {
                let column = left + right * frame as i32 + place % 6;
                let row = top + down * frame as i32 + place / 6;
                pixels[row as usize * SIDE + column as usize] = 0.5 + 0.1 * (place % 5) as f32;
            }
        }
    }
    Tensor::from_vec(frames, (1, count, SIDE * SIDE), &Device::Cpu).unwrap()
}

fn crossing(count: usize) -> Tensor {
    squares(&[([2, 3], [2, 1]), ([22, 20], [-1, -2])], count)
}

/// Weights with noise, so that layers that start at zero hide nothing.
fn noisy(spec: &ModelSpec) -> Parameters {
    let parameters = Parameters::initialize(spec, Seed(2)).unwrap();
    for (index, (_, var)) in parameters.iter().enumerate() {
        let noise = (values(var.dims(), index as f32) * 0.05).unwrap();
        var.set(&(var.as_detached_tensor() + noise).unwrap()).unwrap();
    }
    parameters
}

#[test]
fn every_tensor_is_trained() {
    let spec = spec();
    let parameters = noisy(&spec);
    let network = Network::new(spec.clone(), &parameters).unwrap();
    let frames = crossing(7);
    let [context, coming] = [(0, 4), (4, 3)].map(|(first, count)| frames.narrow(1, first, count).unwrap());
    let predicted = network.predict_sprites(&context).unwrap().unwrap();
    let loss = Loss::Mse.between(&predicted.frames, &coming).unwrap();
    let loss = (loss
        + Loss::Mse
            .between(&predicted.context, &context.contiguous().unwrap())
            .unwrap())
    .unwrap();
    let loss = (loss + motion_loss(&spec, &predicted, &context, &coming).unwrap()).unwrap();
    let gradients = loss.backward().unwrap();
    for (name, var) in parameters.iter() {
        let gradient = gradients.get(var.as_tensor());
        let gradient = gradient.unwrap_or_else(|| panic!("{name} has no gradient"));
        let most = gradient.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(most.is_finite() && most > 0.0, "{name}: {most}");
    }
}

#[test]
fn before_training_everything_goes_straight_on() {
    let spec = spec();
    let network = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = squares(&[([3, 12], [3, -1])], 7);
    let [context, coming] = [(0, 4), (4, 3)].map(|(first, count)| frames.narrow(1, first, count).unwrap());
    let predicted = network.predict_frames(&context, &ConditioningTensors::none()).unwrap();
    let error = |other: &Tensor| {
        (other - &coming)
            .unwrap()
            .sqr()
            .unwrap()
            .sum_all()
            .unwrap()
            .to_scalar::<f32>()
            .unwrap()
    };
    let stays = context.narrow(1, 3, 1).unwrap().repeat((1, 3, 1)).unwrap();
    assert!(
        error(&predicted) < 0.3 * error(&stays),
        "{} {}",
        error(&predicted),
        error(&stays)
    );
    let whole = network.predict_sprites(&context).unwrap().unwrap();
    let way = whole.moves.get(0).unwrap().to_vec2::<f32>().unwrap();
    for (step, way) in way.iter().enumerate() {
        let expected = [3.0, -1.0].map(|speed| speed * (step + 1) as f32);
        assert!(
            (way[0] - expected[0]).abs() < 0.01 && (way[1] - expected[1]).abs() < 0.01,
            "{way:?}"
        );
    }
    let loss = motion_loss(&spec, &whole, &context, &coming)
        .unwrap()
        .to_scalar::<f32>()
        .unwrap();
    assert!(loss < 1e-3, "the square goes on as predicted: {loss}");
}

#[test]
fn what_stands_still_stays_beside_what_moves() {
    let spec = spec();
    let network = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let context = squares(&[([2, 3], [3, 0]), ([20, 22], [0, 0])], 4);
    let predicted = network.predict_sprites(&context).unwrap().unwrap();
    let mut last: Vec<Vec<f32>> = (0..2)
        .map(|sprite| predicted.moves.get(sprite).unwrap().get(2).unwrap().to_vec1().unwrap())
        .collect();
    last.sort_by(|one, other| one[0].total_cmp(&other[0]));
    for (found, expected) in last.iter().flatten().zip([0.0, 0.0, 9.0, 0.0]) {
        assert!((found - expected).abs() < 0.1, "{last:?}");
    }
}

#[test]
fn black_frames_stay_nearly_black() {
    let spec = spec();
    let network = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let black = Tensor::zeros((1, 4, SIDE * SIDE), candle_core::DType::F32, &Device::Cpu).unwrap();
    let predicted = network.predict_frames(&black, &ConditioningTensors::none()).unwrap();
    let most = predicted.max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!((0.0..0.1).contains(&most), "{most}");
}

#[test]
fn windows_and_steps_do_not_depend_on_those_beside_them() {
    let spec = spec();
    let network = Network::detached(spec.clone(), &noisy(&spec)).unwrap();
    let other = squares(&[([10, 10], [1, 1]), ([4, 20], [2, 0])], 4);
    let both = Tensor::cat(&[&crossing(4), &other], 0).unwrap();
    let none = ConditioningTensors::none();
    let together = network.predict_rollouts(&both, &[1, 0, 1], &none).unwrap();
    let alone = network.predict_rollouts(&other, &[0], &none).unwrap();
    for row in [0, 2] {
        assert_eq!(largest_difference(&together.narrow(0, row, 1).unwrap(), &alone), 0.0);
    }
    let sprites = network.predict_sprites(&both).unwrap().unwrap();
    assert_eq!(
        (sprites.moves.dims(), sprites.context.dims()),
        (&[4, 3, 2][..], &[2, 4, SIDE * SIDE][..])
    );
    let first = network.predict_steps(&other, &[0], &none, 1).unwrap();
    assert_eq!(largest_difference(&first, &alone.narrow(1, 0, 1).unwrap()), 0.0);
    let longer = network.predict_steps(&other, &[0], &none, 8).unwrap();
    assert_eq!(longer.dims(), [1, 8, SIDE * SIDE]);
    assert_eq!(largest_difference(&longer.narrow(1, 0, 3).unwrap(), &alone), 0.0);
    // The rest follows the frames that were predicted.
    let again = Tensor::cat(&[&other.narrow(1, 3, 1).unwrap(), &alone], 1).unwrap();
    let again = network.predict_rollouts(&again, &[0], &none).unwrap();
    assert_eq!(largest_difference(&longer.narrow(1, 3, 3).unwrap(), &again), 0.0);
}

#[test]
fn packed_weights_predict_what_the_tensors_predict() {
    let spec = spec();
    let parameters = noisy(&spec);
    let [network, packed] = [(); 2].map(|()| Network::detached(spec.clone(), &parameters).unwrap());
    let packed = packed.packed(Precision::F32).unwrap();
    let none = ConditioningTensors::none();
    let [network, packed] = [network, packed].map(|network| network.predict_frames(&crossing(4), &none).unwrap());
    let apart = largest_difference(&network, &packed);
    assert!(apart < 1e-5, "{apart}");
}

#[test]
fn what_does_not_suit_the_network_is_refused_in_one_sentence() {
    let refused = |change: &dyn Fn(&mut ModelSpec)| {
        let mut spec = spec();
        change(&mut spec);
        spec.validate().unwrap_err().to_string()
    };
    let channel = ChannelScale {
        name: "x".to_owned(),
        unit: "m".to_owned(),
        mean: 0.0,
        std: 1.0,
    };
    assert_eq!(
        refused(&|spec| {
            spec.conditioning = Conditioning::State;
            spec.states = vec![channel.clone()];
        }),
        "model specification: the sprite network takes no actions and no state, but the conditioning is \"state\"; use \"none\""
    );
    assert_eq!(
        refused(&|spec| spec.context = 1),
        "model specification: the sprite network needs a context of 2 frames or more"
    );
    assert!(refused(&|spec| spec.frame_height_px = 30).contains("each side must be a multiple of 4 from 4 to 256"));
    assert!(
        refused(&|spec| {
            spec.architecture = Architecture::Sprites(SpriteSpec {
                motion_hidden: 0,
                ..SpriteSpec::default()
            });
        })
        .contains("sprites.motion_hidden")
    );
}
