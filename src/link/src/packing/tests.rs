use super::*;

fn both() -> (Packing, Packing) {
    let (mut robot, cloud) = (Packing::default(), Packing::default());
    robot.peer_decodes(&decoded_here(false));
    robot.add(1, Schema::OccupancyGrid);
    (robot, cloud)
}

/// A grid of 40×40 cells, known up to `wall`.
fn grid(wall: usize) -> Bytes {
    let mut message = vec![0; 24];
    message.extend_from_slice(&0.5_f32.to_le_bytes());
    message.extend_from_slice(&[40, 0, 0, 0, 40, 0, 0, 0]);
    message.extend_from_slice(&[0; 56]);
    message.extend_from_slice(&1600_u32.to_le_bytes());
    let noise = |at: usize| [0, 100][((at * at * 2_654_435_761) >> 40) & 1];
    message.extend((0..1600).map(|at| if at < wall { noise(at) } else { 255 }));
    message.into()
}

fn pack(packing: &mut Packing, wall: usize, alone: bool) -> Bytes {
    let job = packing.job(1, grid(wall), alone, Some(1e5)).unwrap();
    let packed = job.run();
    packing.done(packed)
}

#[test]
fn what_was_lost_on_the_way_costs_nobody_what_comes_after() {
    let (mut robot, mut cloud) = both();
    let mut lost = 0;
    for wall in (100..1500).step_by(7) {
        let frame = pack(&mut robot, wall, false);
        // Every third is lost, and its place taken by the next.
        if wall % 3 == 0 {
            lost += 1;
            continue;
        }
        if wall % 10 == 0 {
            robot.reconnect();
        }
        let (message, answer) = cloud.unpack(1, &frame);
        assert_eq!(message.unwrap(), grid(wall));
        if let Some(answer) = answer {
            robot.answered(1, answer);
        }
    }
    assert!(lost > 50);
}

#[test]
fn a_message_that_must_be_understood_alone_is() {
    let (mut robot, mut cloud) = both();
    for wall in [100, 110, 120] {
        let frame = pack(&mut robot, wall, false);
        let (message, answer) = cloud.unpack(1, &frame);
        message.unwrap();
        if let Some(answer) = answer {
            robot.answered(1, answer);
        }
    }
    let frame = pack(&mut robot, 130, true);
    let mut stranger = Packing::default();
    assert_eq!(stranger.unpack(1, &frame).0.unwrap(), grid(130));
}

#[test]
fn a_decoder_without_memory_asks_for_a_frame_that_stands_alone() {
    let (mut robot, mut cloud) = both();
    let frame = pack(&mut robot, 800, false);
    let (_, answer) = cloud.unpack(1, &frame);
    robot.answered(1, answer.unwrap());
    let mut forgetful = Packing::default();
    // The first candidates are tried once each: one of the next refers to the first.
    let asked = (801..900).find_map(|wall| {
        let frame = pack(&mut robot, wall, false);
        let (message, answer) = forgetful.unpack(1, &frame);
        (message.is_err() && answer == Some(Answer::Keyframe)).then_some(())
    });
    assert!(asked.is_some());
    robot.answered(1, Answer::Keyframe);
    let frame = pack(&mut robot, 1000, false);
    assert_eq!(forgetful.unpack(1, &frame).0.unwrap(), grid(1000));
}

#[test]
fn encoding_pays_where_the_link_is_slow_and_the_peer_decodes() {
    let (robot, cloud) = both();
    assert!(robot.pays(Some(2.5e6)));
    assert!(!robot.pays(Some(1e9)) && !robot.pays(None));
    assert!(
        !cloud.pays(Some(2.5e6)),
        "it was not told what its peer decodes"
    );
    let mut old = Packing::default();
    old.peer_decodes(&["raw".to_owned(), "zstd".to_owned()]);
    assert!(!old.pays(Some(2.5e6)));
}

#[test]
fn broken_frames_are_refused() {
    let mut cloud = Packing::default();
    for frame in [&[][..], &[0xff, 1, 1, 1], &[0x10, 1, 1, 0xff, 0xff]] {
        assert!(cloud.unpack(1, frame).0.is_err());
    }
}
