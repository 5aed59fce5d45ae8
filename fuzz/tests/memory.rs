//! Memory that decoders allocate, as counted by an allocator: for the stored corpus, for modifications of it, and for
//! texts with a repeated part. `FUZZ_ROUNDS` sets the number of modified inputs per decoder.

use fuzz::damage::{Dice, load_corpus};
use fuzz::decoders::{DECODERS, Decoder};
use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

/// Sizes of generated inputs, in bytes.
const SIZES: [usize; 3] = [512, 16 << 10, 256 << 10];

/// Returns the peak of the bytes that a decoder held. Nothing else allocates meanwhile.
fn peak_bytes(decoder: &Decoder, input: &[u8]) -> usize {
    let before = ALLOCATOR.current_usage();
    ALLOCATOR.reset_peak_usage();
    (decoder.decode)(input);
    ALLOCATOR.peak_usage().saturating_sub(before)
}

/// The worst input of a decoder.
#[derive(Default)]
struct WorstInput {
    /// Bytes of memory per byte of input.
    times: f64,
    input: String,
}

fn measure(decoder: &Decoder, input: &[u8], worst: &mut WorstInput) {
    let taken = peak_bytes(decoder, input);
    let shown = || {
        let begin = String::from_utf8_lossy(&input[..input.len().min(120)]).into_owned();
        format!("{}, {} bytes: {begin:?}", decoder.name, input.len())
    };
    let most = decoder.times * input.len() + decoder.fixed;
    assert!(taken <= most, "{taken} bytes were taken, {most} may be, for {}", shown());
    if let Some(weigh) = decoder.weigh {
        let weight = weigh(input);
        // The message of an error is not part of the estimate.
        let most = weight + (4 << 10);
        assert!(taken <= most, "{taken} bytes were taken, {weight} counted, for {}", shown());
    }
    let times = taken.saturating_sub(decoder.fixed) as f64 / input.len().max(1) as f64;
    if times > worst.times {
        *worst = WorstInput { times, input: shown() };
    }
}

#[test]
fn decoders_take_a_bounded_multiple_of_their_input() {
    let rounds = std::env::var("FUZZ_ROUNDS").map_or(300, |text| text.parse().expect("a number"));
    for decoder in DECODERS {
        let mut worst = WorstInput::default();
        let seeds = load_corpus(decoder.name);
        // One-time allocations are made beforehand.
        seeds.iter().for_each(|seed| (decoder.decode)(seed));
        for seed in &seeds {
            measure(decoder, seed, &mut worst);
        }
        for repeat in decoder.repeats {
            for size in SIZES {
                let text = repeat.text(size);
                measure(decoder, text.as_bytes(), &mut worst);
            }
        }
        let mut dice = Dice::default();
        for round in 0..rounds {
            let mut input = seeds[round % seeds.len()].clone();
            let other = &seeds[round / seeds.len() % seeds.len()];
            dice.damage(&mut input, other);
            if round % 3 == 0 {
                dice.repeat(&mut input, SIZES[round / 3 % SIZES.len()]);
            }
            measure(decoder, &input, &mut worst);
        }
        println!("{:>8.1} of {}: {}", worst.times, decoder.times, worst.input);
    }
}
