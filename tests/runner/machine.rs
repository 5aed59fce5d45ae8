//! Requirements of the stories for the machine. Anything missing is reported in one line, with its consequence.

use std::path::Path;

use nix::mount::{MsFlags, mount, umount};

use support::world::{self, world};
use support::{binaries, cable, claim, disk, procfs};

/// Maximum space in bytes that homes take in the directory for temporary files if there is no separate disk.
const ROOM: u64 = 12 << 30;
/// Space in bytes that the homes of one story take at most.
const ROOM_PER_STORY: u64 = 2 << 30;

/// Checks the machine, cleans up after killed runs, and mounts a disk for this run of so many stories. Must be called
/// before this process has threads.
///
/// # Errors
/// If a requirement is not met: what is missing, and what to do.
pub(super) fn prepare(stories: usize) -> Result<(), String> {
    if !nix::unistd::geteuid().is_root() {
        return Err("servants are started by root: sudo make stories".to_owned());
    }
    check_cgroups()?;
    disk::enter_namespace().map_err(|error| {
        format!(
            "{error:#}, and robots' file systems are mounted: run the stories \
        as root of the machine"
        )
    })?;
    for place in claim::find_abandoned(&std::env::temp_dir(), world::PREFIX) {
        match claim::remove_abandoned(&place) {
            Ok(()) => println!("removed {}, which a run that was killed had left", place.display()),
            Err(error) => println!("{} stays, which a run that was killed had left: {error:#}", place.display()),
        }
    }
    for name in cable::find_abandoned() {
        match cable::remove_namespace(&name) {
            Ok(()) => println!("removed the network {name}, which a run that was killed had left"),
            Err(error) => println!("the network {name} stays, which a run that was killed had left: {error:#}"),
        }
    }
    let place = world().place();
    if let Err(error) = disk::mount_on(place, &binaries::cache()) {
        println!(
            "no disk of their own for the stories' homes, which then are on that of {} and take longer: {error:#}",
            place.display()
        );
        check_room(place, ROOM.min(ROOM_PER_STORY.saturating_mul(stories as u64)))?;
    }
    check_overlay(place)
}

/// Checks that cgroups with limits can be used: servants have one below the daemon's.
fn check_cgroups() -> Result<(), String> {
    let mut is_there = false;
    for parent in procfs::cgroups(std::process::id() as i32) {
        let has_limits = ["cpu.shares", "memory.limit_in_bytes", "cgroup.controllers"];
        if !has_limits.iter().any(|file| parent.join(file).exists()) {
            continue;
        }
        is_there = true;
        let child = parent.join(format!("cloudroid-check-{}", std::process::id()));
        std::fs::create_dir(&child).map_err(|error| {
            format!(
                "cgroups cannot be made below {} ({error}), and servants have limits: run the stories where root \
                may make them",
                parent.display()
            )
        })?;
        let _ = std::fs::remove_dir(child);
    }
    if is_there {
        return Ok(());
    }
    Err("no cgroups with limits are mounted below /sys/fs/cgroup, and servants have limits: mount them, or run the \
        stories elsewhere"
        .to_owned())
}

fn check_room(place: &Path, room: u64) -> Result<(), String> {
    let free = disk::free_bytes(place).map_err(|error| format!("{error:#}"))?;
    if free < room {
        let (free, room) = (free >> 30, room >> 30);
        return Err(format!(
            "{} has {free} GB free, and homes take {room} GB: make room there, or name another place by TMPDIR",
            place.display()
        ));
    }
    Ok(())
}

/// Checks that overlays can be mounted: a servant's root is one, which is not possible on top of another overlay, for
/// example.
fn check_overlay(place: &Path) -> Result<(), String> {
    let trial = place.join("overlay");
    let names = ["lower", "upper", "work", "root"];
    let made = names.iter().try_for_each(|name| std::fs::create_dir_all(trial.join(name)));
    made.map_err(|error| format!("{}: {error}", trial.display()))?;
    let at = |name: &str| trial.join(name).display().to_string();
    let options = format!("lowerdir={},upperdir={},workdir={}", at("lower"), at("upper"), at("work"));
    // Some file systems only fail when something is renamed or removed.
    let used =
        mount(Some("overlay"), trial.join("root").as_path(), Some("overlay"), MsFlags::empty(), Some(options.as_str()))
            .map_err(std::io::Error::from)
            .and_then(|()| {
                let used = std::fs::write(trial.join("root/file"), "")
                    .and_then(|()| std::fs::remove_file(trial.join("root/file")));
                umount(&trial.join("root")).map_err(std::io::Error::from).and(used)
            });
    let _ = std::fs::remove_dir_all(&trial);
    used.map_err(|error| {
        format!(
            "the file system of {} cannot hold the upper directories of overlays ({error}), which servants are \
            made of: name another place by TMPDIR",
            place.display()
        )
    })
}
