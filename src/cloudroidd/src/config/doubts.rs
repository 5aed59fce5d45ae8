//! Warnings about settings that exceed the machine: they are allowed, but cannot be kept.

use api::Size;

use super::Config;
use crate::machine::MachineResources;

impl Config {
    /// Returns a warning for each setting that exceeds this machine, with what to write instead.
    pub fn machine_warnings(&self, has: MachineResources) -> Vec<String> {
        let MachineResources { cores, memory } = has;
        let mut doubts = Vec::new();
        let capacity = &self.capacity;
        if let Some(cpus) = capacity.cpus.filter(|cpus| *cpus > cores) {
            doubts.push(format!(
                "[capacity] cpus = {cpus} is more than the {cores} cores of this machine, so servants get less than is \
                    reserved; omit it, or set overcommit to reserve cores more than once"
            ));
        }
        if let Some(size) = capacity.memory.filter(|size| size.0 > memory) {
            doubts.push(format!(
                "[capacity] memory = {size} is more than the {} of this machine, so servants can be killed within \
                    their limits; omit it to use nine tenths of the memory",
                Size(memory)
            ));
        }
        if let Some(cpus) = self.limits.cpus.filter(|cpus| *cpus > cores) {
            doubts.push(format!("[limits] cpus = {cpus} has no effect: this machine has {cores} cores"));
        }
        let promised = capacity.cpus.unwrap_or(cores) * capacity.overcommit;
        let reserve = self.servant.reserve_cpus;
        if reserve > promised {
            doubts.push(format!(
                "[servant] reserve_cpus = {reserve} is more than the {promised} cores of [capacity]: servants that \
                    request no cores cannot start"
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
        let has = MachineResources { cores: 2.0, memory: 16 << 30 };
        let doubts = |text: &str| Config::parse(text).expect("valid").machine_warnings(has);
        for fits in [
            "",
            "[capacity]\ncpus = 2\nmemory = \"16G\"\novercommit = 3\n[limits]\ncpus = 2\n[servant]\nreserve_cpus = 6.0",
        ] {
            assert_eq!(doubts(fits), Vec::<String>::new(), "{fits}");
        }
        for (text, words) in [
            ("[capacity]\ncpus = 64", "[capacity] cpus = 64 is more than the 2 cores"),
            ("[capacity]\nmemory = \"1T\"", "is more than the 16G of this machine"),
            ("[limits]\ncpus = 99", "[limits] cpus = 99 has no effect"),
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
