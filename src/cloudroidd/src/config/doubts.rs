//! What is configured beyond the machine: it is allowed, and worth a warning.

use api::Size;

use super::Config;
use crate::machine::Has;

impl Config {
    /// What this machine cannot keep, each with what to write instead.
    pub fn doubts(&self, has: Has) -> Vec<String> {
        let Has { cores, memory } = has;
        let mut doubts = Vec::new();
        let capacity = &self.capacity;
        if let Some(cpus) = capacity.cpus.filter(|cpus| *cpus > cores) {
            doubts.push(format!(
                "[capacity] cpus = {cpus} is more than the {cores} cores of this machine, so that promises are not kept; leave it out, \
                 or write overcommit where cores are to be promised more than once"
            ));
        }
        if let Some(size) = capacity.memory.filter(|size| size.0 > memory) {
            doubts.push(format!(
                "[capacity] memory = {size} is more than the {} of this machine, so that servants are killed that keep within theirs; \
                 leave it out: nine tenths are promised then",
                Size(memory)
            ));
        }
        if let Some(cpus) = self.limits.cpus.filter(|cpus| *cpus > cores) {
            doubts.push(format!(
                "[limits] cpus = {cpus} limits nothing: this machine has {cores} cores"
            ));
        }
        let promised = capacity.cpus.unwrap_or(cores) * capacity.overcommit;
        let reserve = self.servant.reserve_cpus;
        if reserve > promised {
            doubts.push(format!(
                "[servant] reserve_cpus = {reserve} is more than the {promised} cores of [capacity]: no servant is started that asks for none"
            ));
        }
        doubts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_beyond_the_machine_is_named() {
        let has = Has {
            cores: 2.0,
            memory: 16 << 30,
        };
        let doubts = |text: &str| Config::parse(text).expect("valid").doubts(has);
        for fits in [
            "",
            "[capacity]\ncpus = 2\nmemory = \"16G\"\novercommit = 3\n[limits]\ncpus = 2\n[servant]\nreserve_cpus = 6.0",
        ] {
            assert_eq!(doubts(fits), Vec::<String>::new(), "{fits}");
        }
        for (text, words) in [
            (
                "[capacity]\ncpus = 64",
                "[capacity] cpus = 64 is more than the 2 cores",
            ),
            (
                "[capacity]\nmemory = \"1T\"",
                "is more than the 16G of this machine",
            ),
            ("[limits]\ncpus = 99", "[limits] cpus = 99 limits nothing"),
            (
                "[capacity]\ncpus = 1\n[servant]\nreserve_cpus = 1.5",
                "[servant] reserve_cpus = 1.5 is more than the 1 cores",
            ),
        ] {
            let doubts = doubts(text);
            assert!(doubts.len() == 1 && doubts[0].contains(words), "{doubts:?}");
        }
    }
}
