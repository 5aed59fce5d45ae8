//! Runs the stored corpus, unchanged and modified, through every target: what the fuzzer once found stays found, and a
//! few new inputs are tried on every run. `FUZZ_ROUNDS` sets the number of modified inputs per target.

use fuzz::damage::{Dice, load_corpus};
use fuzz::{TARGETS, Target};

fn replay(name: &str, target: Target) {
    let seeds = load_corpus(name);
    for seed in &seeds {
        target(seed);
    }
    let rounds = std::env::var("FUZZ_ROUNDS").map_or(3000, |text| text.parse().unwrap());
    let mut dice = Dice::default();
    for round in 0..rounds {
        let mut bytes = seeds[round % seeds.len()].clone();
        dice.damage(&mut bytes, &seeds[round / seeds.len() % seeds.len()]);
        let shown = bytes.clone();
        let tried = std::panic::catch_unwind(|| target(&bytes));
        assert!(tried.is_ok(), "{name}, round {round}: {shown:02x?}");
    }
}

#[test]
fn the_corpus_whole_and_damaged_is_read_or_refused() {
    std::thread::scope(|scope| {
        for &(name, target) in TARGETS {
            scope.spawn(move || replay(name, target));
        }
    });
}
