//! Stories that need a machine of their own: systemd, cgroup v2, installing and removing a package, power cuts. They
//! run as root in the virtual machine that `make test-vm` starts (`tests/vm/run`), over several boots:
//!
//! ```text
//!   boot 1   install the package ─▶ stories ─▶ first half of the first cut ─▶ power off
//!   boot 2   second half of the first cut ─▶ first half of the second cut ─▶ power off
//!   …
//!   last     second half of the last cut ─▶ remove the package ─▶ make install ─▶ make uninstall
//! ```

use std::process::ExitCode;
use std::time::Instant;

use support::Verdict;

#[path = "stories/confinement.rs"]
mod confinement;
#[path = "stories/cuts.rs"]
mod cuts;
#[path = "stories/installation.rs"]
mod installation;
#[path = "stories/limits.rs"]
mod limits;
mod machine;
#[path = "stories/restarts.rs"]
mod restarts;
#[path = "stories/sla.rs"]
mod sla;

/// A story with the name of its function.
struct VmStory {
    name: &'static str,
    tell: fn() -> Verdict,
}

/// A power cut during some operation.
struct Cut {
    name: &'static str,
    /// Runs before the cut, and returns in the middle of the operation.
    before: fn() -> Verdict,
    /// Runs at the next boot.
    after: fn() -> Verdict,
}

macro_rules! stories {
    ($module:ident: $($name:ident),+ $(,)?) => {
        vec![$(VmStory { name: concat!(stringify!($module), "::", stringify!($name)), tell: $module::$name }),+]
    };
}

macro_rules! cuts {
    ($($name:ident),+ $(,)?) => {
        vec![$(Cut { name: concat!("cuts::", stringify!($name)), before: cuts::$name::before,
            after: cuts::$name::after }),+]
    };
}

fn main() -> ExitCode {
    let Some(boot) = machine::boot_number() else {
        println!("told in a virtual machine only: make test-vm");
        return ExitCode::SUCCESS;
    };
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let chosen = |name: &str| wanted.is_empty() || wanted.iter().any(|word| name.contains(word));
    let stories: Vec<VmStory> = [
        stories![limits:
            limits_are_in_the_kernels_own_files,
            cores_are_shared_out_as_asked,
            a_promised_servant_is_held_up_by_no_greedy_neighbours,
            who_takes_too_much_memory_is_told_so,
            a_fork_bomb_ends_when_its_servant_does,
        ],
        stories![
            sla: what_robots_state_becomes_what_the_kernel_enforces_and_is_kept,
            the_controller_moves_cores_and_nobody_loses_what_was_promised
        ],
        stories![confinement:
            no_attempt_to_break_out_succeeds,
            nothing_of_the_host_is_reached,
            neighbours_are_not_reached,
            a_service_is_given_what_its_operator_allows,
        ],
        stories![restarts:
            a_killed_daemon_is_started_again_and_finds_its_servants,
            a_restart_loses_nothing,
            after_a_restart_of_the_unit_no_two_servants_have_the_same_user_ids,
        ],
    ]
    .into_iter()
    .flatten()
    .filter(|story| chosen(story.name))
    .collect();
    let cuts: Vec<Cut> = cuts![in_the_middle_of_a_start, in_the_middle_of_a_push, in_the_middle_of_a_database_write,]
        .into_iter()
        .filter(|cut| chosen(cut.name))
        .collect();

    if boot == 1 {
        run_story("installation::a_package_leaves_a_running_service", installation::installs);
        if machine::daemon().is_err() {
            return machine::verdict();
        }
        for story in stories {
            run_story(story.name, story.tell);
        }
    } else {
        let cut = &cuts[boot - 2];
        run_story(cut.name, cut.after);
    }
    if let Some(cut) = cuts.get(boot - 1) {
        match (cut.before)() {
            Ok(()) => machine::cut_power(),
            Err(error) => run_story(cut.name, move || Err(error)),
        }
    }
    const REMOVAL: &str = "installation::removal_leaves_the_state_alone";
    const BY_MAKE: &str = "installation::what_make_install_puts_there_runs_and_goes_again";
    // The second starts from the state that the first leaves.
    if chosen(REMOVAL) || chosen(BY_MAKE) {
        run_story(REMOVAL, installation::removes);
        run_story(BY_MAKE, installation::installs_and_removes_without_a_package);
    }
    machine::verdict()
}

/// Runs a story and prints its result.
fn run_story(name: &str, tell: impl FnOnce() -> Verdict) {
    let began = Instant::now();
    let outcome = tell();
    let took = began.elapsed().as_secs_f64();
    match outcome {
        Ok(()) => println!("ok      {name} ({took:.1} s)"),
        Err(error) => {
            println!("FAILED  {name} ({took:.1} s)\n{error:#}\n{}", machine::log_tail());
            machine::record_failure(name);
        }
    }
}
