use super::*;

fn codec_pair() -> (SessionCodecs, SessionCodecs) {
    let (mut robot, cloud) = (SessionCodecs::default(), SessionCodecs::default());
    robot.set_peer_codecs(&supported_codecs(|_| false), None);
    robot.add(1, Schema::OccupancyGrid);
    (robot, cloud)
}

/// An occupancy grid of 40×40 cells, known up to cell `wall`.
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

fn encode(packing: &mut SessionCodecs, wall: usize, alone: bool) -> Bytes {
    let job = packing.encode_job(1, grid(wall), alone, Some(1e5)).unwrap();
    let packed = job();
    packing.finish(packed).0
}

#[test]
fn a_message_that_is_being_encoded_when_its_connection_is_lost_spoils_none_after_it() {
    let (mut robot, mut cloud) = codec_pair();
    for wall in (100..1500).step_by(7) {
        let job = robot.encode_job(1, grid(wall), false, Some(1e5)).unwrap();
        // Every fifth job is abandoned: its connection is lost, and its encoder with it.
        if wall % 5 == 0 {
            drop(job());
            robot.reconnect();
            continue;
        }
        let frame = robot.finish(job()).0;
        let (message, answer) = cloud.decode(1, &frame);
        assert!(message.unwrap() == grid(wall), "{wall}");
        if let Some(answer) = answer {
            robot.on_answer(1, answer);
        }
    }
}

#[test]
fn every_grid_is_understood_alone() {
    let (mut robot, mut cloud) = codec_pair();
    for wall in (100..1500).step_by(7) {
        let frame = encode(&mut robot, wall, wall % 3 == 0);
        let mut stranger = SessionCodecs::default();
        for receiver in [&mut stranger, &mut cloud] {
            let (message, answer) = receiver.decode(1, &frame);
            assert!(message.unwrap() == grid(wall), "{wall}");
            assert_eq!(answer, None);
        }
    }
}

#[test]
fn pictures_lose_detail_only_where_both_ends_say_so() {
    let names = |welcome: fn(Codec) -> bool| supported_codecs(welcome);
    assert!(names(|_| false).iter().all(|name| name != "jpeg" && name != "video"));
    assert!(names(|codec| codec == Codec::Jpeg).contains(&"jpeg".to_owned()));
    // Codecs that are not built in are not announced.
    let video = names(|codec| codec == Codec::Video).contains(&"video".to_owned());
    assert_eq!(video, Codec::Video.is_available());
    let mut robot = SessionCodecs::new(Some(Duration::from_millis(400)));
    robot.set_peer_codecs(&names(|codec| codec == Codec::Jpeg), Some(50));
    assert_eq!(robot.lossy, Some(Codec::Jpeg));
    robot.add(1, Schema::Image);
    // On a link that needs a second for an uncompressed image, the fastest lossless codec takes longer than T_max
    // allows.
    let mut used = Vec::new();
    for number in 0..60 {
        let job = robot.encode_job(1, noisy(number), false, Some(60e3)).unwrap();
        let frame = robot.finish(job()).0;
        used.push(codec::peek(&frame).unwrap().codec);
        let (message, _) = SessionCodecs::default().decode(1, &frame);
        assert_eq!(message.unwrap().len(), noisy(number).len());
    }
    assert_eq!(used.last(), Some(&Codec::Jpeg), "{used:?}");
}

/// An image that lossless codecs cannot compress well.
fn noisy(number: u32) -> Bytes {
    let mut message = vec![0; 12];
    message.extend([0; 4]);
    for word in [120_u32, 160] {
        message.extend(word.to_le_bytes());
    }
    message.extend(4_u32.to_le_bytes());
    message.extend(b"rgb8\x00");
    message.extend(480_u32.to_le_bytes());
    message.extend(57_600_u32.to_le_bytes());
    let noise = |at: u32| (at ^ number).wrapping_mul(2_654_435_761) >> 28;
    message.extend((0..57_600).map(|at| (at / 480) as u8 + noise(at) as u8));
    message.into()
}

#[test]
fn encoding_pays_where_the_link_is_slow_and_the_peer_decodes() {
    let (robot, cloud) = codec_pair();
    assert!(robot.is_worthwhile(Some(2.5e6)));
    assert!(!robot.is_worthwhile(Some(1e9)) && !robot.is_worthwhile(None));
    assert!(!cloud.is_worthwhile(Some(2.5e6)), "it was not told what its peer decodes");
    let mut old = SessionCodecs::default();
    old.set_peer_codecs(&["raw".to_owned(), "zstd".to_owned()], None);
    assert!(!old.is_worthwhile(Some(2.5e6)));
}

#[test]
fn broken_frames_are_refused() {
    let mut cloud = SessionCodecs::default();
    for frame in [&[][..], &[0xff, 1, 1, 1], &[0x10, 2, 1, 0xff]] {
        let (message, answer) = cloud.decode(1, frame);
        assert!(message.is_err());
        assert_eq!(answer, Some(ReceiverFeedback::Damaged));
    }
}
