//! Participants on a network made of queues: it loses what it is told to lose, and time passes when nothing else happens.

use std::net::IpAddr;

use parking_lot::Mutex;

use super::*;
use crate::locator::Locator;
use crate::participant::Topic;
use crate::qos::Reliability;
use crate::reader::Bounds;
use crate::sequence::SequenceSet;
use crate::{SampleIdentity, wire};

/// What a reader has read.
#[derive(Default)]
struct Read(Mutex<Vec<Sample>>);

impl Sink for Read {
    fn sample(&self, sample: Sample) {
        self.0.lock().push(sample);
    }
}

impl Read {
    fn lengths(&self) -> Vec<usize> {
        self.0
            .lock()
            .iter()
            .map(|sample| sample.payload.len())
            .collect()
    }

    /// The first byte behind the header of each.
    fn marks(&self) -> Vec<u8> {
        self.0
            .lock()
            .iter()
            .map(|sample| sample.payload[4])
            .collect()
    }
}

/// Says of a datagram, by its number and bytes, whether it is lost.
type Loses = Box<dyn FnMut(usize, &[u8]) -> bool>;

struct World {
    now: Instant,
    engines: Vec<Engine>,
    /// Which of all datagrams are lost, by their number.
    loses: Loses,
    sent: usize,
    /// What receivers take at a time, in bytes; all if none.
    room: Option<usize>,
    /// Of samples that are not whole yet.
    budget: budget::Budget,
}

const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

/// Ports of this machine.
fn bound<const N: usize>(ports: [u16; N]) -> BTreeSet<SocketAddrV4> {
    let at = |port| SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, port);
    ports.into_iter().map(at).collect()
}

fn discovery_of(index: usize) -> u16 {
    7410 + 2 * index as u16
}

impl World {
    fn of(participants: usize) -> Self {
        let mut world = Self {
            now: Instant::now(),
            engines: Vec::new(),
            loses: Box::new(|_, _| false),
            sent: 0,
            room: None,
            budget: budget::Budget::new("samples", 1 << 30),
        };
        (0..participants).for_each(|_| world.join());
        world
    }

    fn join(&mut self) {
        let index = self.engines.len();
        let at = |port: u16| vec![Locator::from((std::net::Ipv4Addr::LOCALHOST, port))];
        let own = ParticipantData {
            prefix: GuidPrefix([index as u8 + 1; 12]),
            vendor: VendorId::OURS,
            version: [2, 3],
            domain: Some(0),
            name: format!("participant {index}"),
            user_data: Bytes::new(),
            discovery: at(discovery_of(index)),
            user: at(discovery_of(index) + 1),
            builtin: BUILTIN,
            lease: Some(Duration::from_secs(10)),
        };
        let bounds = Bounds {
            max_sample: 16 << 20,
            budget: self.budget.clone(),
            unfinished: Duration::from_secs(30),
        };
        let announce_to = (0..4)
            .map(|other| SocketAddr::from(([127, 0, 0, 1], discovery_of(other))))
            .collect();
        let ports = Ports::of(0).expect("a domain");
        self.engines.push(Engine::new(
            self.now,
            Settings {
                own,
                ports,
                bounds,
                announce_to,
                servers: Vec::new(),
                network: Network::new(Vec::new()),
                alone: false,
            },
        ));
    }

    /// Carries what there is to carry, once; whether there was anything.
    fn carry(&mut self) -> bool {
        let mut carried = false;
        for index in 0..self.engines.len() {
            let mut left = self.room.unwrap_or(usize::MAX);
            let mut out = Vec::new();
            while let Some(datagram) = self.engines[index].transmit(&mut |_, length, _| {
                let fits = left >= length;
                left -= if fits { length } else { 0 };
                fits
            }) {
                out.push(datagram);
            }
            for datagram in out {
                carried = true;
                let bytes: Bytes = datagram
                    .parts()
                    .iter()
                    .flat_map(|part| part.to_vec())
                    .collect();
                self.sent += 1;
                if (self.loses)(self.sent, &bytes) {
                    continue;
                }
                let to = usize::from((datagram.to.port() - 7410) / 2);
                if let Some(engine) = self.engines.get_mut(to) {
                    engine.receive(self.now, HERE, &bytes);
                }
            }
        }
        for engine in &mut self.engines {
            for (sink, sample) in engine.take_deliveries() {
                sink.sample(sample);
            }
        }
        carried
    }

    /// Lets the world go on for so long.
    fn pass(&mut self, duration: Duration) {
        let until = self.now + duration;
        for _ in 0..200_000 {
            if self.carry() {
                continue;
            }
            let next = self
                .engines
                .iter()
                .map(Engine::tick_at)
                .min()
                .unwrap_or(until);
            if next > until {
                break;
            }
            self.now = self.now.max(next);
            for engine in &mut self.engines {
                if engine.tick_at() <= self.now {
                    engine.tick(self.now);
                }
            }
        }
        self.now = until;
    }

    fn writer(&mut self, engine: usize, qos: EndpointQos) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let now = self.now;
        self.engines[engine].add_writer(now, &topic(), qos)
    }

    fn reader(
        &mut self,
        engine: usize,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<Ends>>, Arc<Read>) {
        let now = self.now;
        let read = Arc::new(Read::default());
        let (guid, ends) = self.engines[engine].add_reader(now, &topic(), qos, read.clone());
        (guid, ends, read)
    }

    fn write(&mut self, writer: Guid, mark: u8, length: usize) {
        let now = self.now;
        let mut payload = vec![mark; length];
        payload[..4].copy_from_slice(&[0, 1, 0, 0]);
        let index = usize::from(writer.prefix.0[0]) - 1;
        self.engines[index].write(now, writer.entity, payload.into(), None);
    }
}

fn topic() -> Topic {
    Topic {
        name: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

fn keep(depth: u32) -> EndpointQos {
    EndpointQos {
        history: History::KeepLast(depth),
        ..EndpointQos::default()
    }
}

fn best_effort() -> EndpointQos {
    EndpointQos {
        reliability: Reliability::BestEffort,
        ..keep(10)
    }
}

fn transient(depth: u32) -> EndpointQos {
    EndpointQos {
        durability: Durability::TransientLocal,
        ..keep(depth)
    }
}

const SECOND: Duration = Duration::from_secs(1);

/// Numbers that look random and are the same every time.
fn scattered(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    }
}

#[test]
fn participants_find_each_other_and_samples_arrive_in_order() {
    let mut world = World::of(2);
    let (writer, writer_ends) = world.writer(0, keep(10));
    let (reader, reader_ends, read) = world.reader(1, keep(10));
    world.pass(SECOND / 5);
    assert_eq!(writer_ends.borrow().confirmed, [reader]);
    assert_eq!(reader_ends.borrow().confirmed, [writer]);
    for (mark, length) in [
        (1, 8),
        (2, 100_000),
        (3, 8),
        (4, 15_872),
        (5, 15_873),
        (6, 3_000_001),
    ] {
        world.write(writer, mark, length);
    }
    world.pass(SECOND / 10);
    assert_eq!(read.marks(), [1, 2, 3, 4, 5, 6]);
    assert_eq!(read.lengths(), [8, 100_000, 8, 15_872, 15_873, 3_000_001]);
    let discovered = world.engines[0].discovered().borrow().clone();
    assert_eq!(discovered.participants.len(), 1);
    assert_eq!(
        discovered.readers.keys().copied().collect::<Vec<_>>(),
        [reader]
    );
}

#[test]
fn whatever_the_network_loses_reliable_samples_come_once_and_in_order() {
    for seed in 0..20 {
        let mut world = World::of(2);
        let mut random = scattered(seed);
        world.loses = Box::new(move |_, _| random() % 4 == 0);
        let (writer, _) = world.writer(0, keep(100));
        let (_, _, read) = world.reader(1, keep(100));
        world.pass(SECOND * 5);
        let mut random = scattered(seed + 1000);
        for mark in 0..50 {
            world.write(writer, mark, 8 + (random() % 60_000) as usize);
            world.pass(Duration::from_millis(random() % 30));
        }
        world.pass(SECOND * 20);
        assert_eq!(read.marks(), (0..50).collect::<Vec<u8>>(), "seed {seed}");
    }
}

#[test]
fn best_effort_samples_are_whole_or_lost_and_never_out_of_order() {
    for seed in 0..10 {
        let mut world = World::of(2);
        let (writer, _) = world.writer(0, best_effort());
        let (_, _, read) = world.reader(1, best_effort());
        world.pass(SECOND);
        let mut random = scattered(seed);
        world.loses = Box::new(move |_, _| random() % 20 == 0);
        for mark in 0..100 {
            world.write(writer, mark, 8 + usize::from(mark % 3) * 40_000);
            world.pass(Duration::from_millis(10));
        }
        let marks = read.marks();
        assert!(
            marks.is_sorted_by(|before, after| before < after),
            "seed {seed}: {marks:?}"
        );
        assert!(
            (50..100).contains(&marks.len()),
            "seed {seed}: {} of 100",
            marks.len()
        );
        for (mark, length) in marks.iter().zip(read.lengths()) {
            assert_eq!(length, 8 + usize::from(mark % 3) * 40_000);
        }
    }
}

#[test]
fn a_sample_of_which_parts_were_lost_is_whole_in_the_end_however_many_follow() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // One in three datagrams is lost, and each sample is replaced long before it is repaired.
    let mut random = scattered(7);
    world.loses = Box::new(move |_, _| random() % 3 == 0);
    let fragmented = 20 * 16_000;
    for mark in 1..=10 {
        world.write(writer, mark, fragmented);
        world.pass(Duration::from_millis(2));
    }
    world.loses = Box::new(|_, _| false);
    world.pass(SECOND * 5);
    assert_eq!(read.marks(), (1..=10).collect::<Vec<u8>>());
    assert_eq!(world.engines[0].dropped(writer.entity), 0);
}

#[test]
fn no_more_is_begun_to_a_reader_than_it_acknowledges() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // Whatever the reader says is lost for a while: the first two samples fill the window, and others replace each other behind.
    world.loses = Box::new(|_, bytes| bytes.starts_with(b"RTPS") && bytes[8..20] == [2; 12]);
    for mark in 1..=40 {
        world.write(writer, mark, 5 << 20);
        world.pass(Duration::from_millis(2));
    }
    world.loses = Box::new(|_, _| false);
    world.pass(SECOND * 2);
    assert_eq!(read.marks(), [1, 2, 40]);
}

#[test]
fn whoever_was_given_up_by_one_side_alone_is_met_again_by_both() {
    for forgets in [0, 1] {
        let mut world = World::of(2);
        let (writer, _) = world.writer(0, keep(10));
        let (reader, reader_ends, read) = world.reader(1, keep(10));
        world.pass(SECOND * 5);
        world.write(writer, 1, 8);
        world.pass(SECOND);
        // As after a pause of the network that was longer than one lease and shorter than the other.
        let other = [reader.prefix, writer.prefix][forgets];
        world.engines[forgets].participant_gone(other);
        world.engines[forgets].settle();
        world.pass(SECOND * 9);
        world.write(writer, 2, 100_000);
        world.pass(SECOND);
        assert_eq!(read.marks(), [1, 2], "{forgets} forgets");
        assert_eq!(reader_ends.borrow().confirmed, [writer]);
    }
}

#[test]
fn newcomers_are_given_what_is_kept_for_them_and_nothing_else() {
    let mut world = World::of(2);
    let (kept, _) = world.writer(0, transient(2));
    (1..=5).for_each(|mark| world.write(kept, mark, 8));
    world.pass(SECOND);
    let (_, _, wants_past) = world.reader(1, transient(10));
    let (_, _, wants_none) = world.reader(1, keep(10));
    world.pass(SECOND);
    assert_eq!(wants_past.marks(), [4, 5]);
    assert_eq!(wants_none.marks(), []);
    world.write(kept, 6, 8);
    world.pass(SECOND);
    assert_eq!(wants_past.marks(), [4, 5, 6]);
    assert_eq!(wants_none.marks(), [6]);
}

#[test]
fn ends_that_do_not_fit_are_told_why_and_others_are_not_disturbed() {
    let mut world = World::of(2);
    let (writer, writer_ends) = world.writer(0, best_effort());
    let (reader, reader_ends, refused) = world.reader(1, keep(10));
    let (other, _, taken) = world.reader(1, best_effort());
    world.pass(SECOND);
    world.write(writer, 1, 8);
    world.pass(SECOND);
    assert_eq!((refused.marks(), taken.marks()), (vec![], vec![1]));
    let ends = writer_ends.borrow().clone();
    assert_eq!(
        ends.matched.iter().map(|end| end.guid).collect::<Vec<_>>(),
        [other]
    );
    assert_eq!(ends.refused.len(), 1);
    assert_eq!(ends.refused[0].0.guid, reader);
    assert_eq!(reader_ends.borrow().refused[0].1[0].policy, "reliability");
}

#[test]
fn who_falls_silent_is_gone_when_the_lease_is_over() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.loses = Box::new(|_, bytes| bytes[8] == 2);
    world.pass(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 1);
    world.pass(SECOND * 8);
    assert_eq!(ends.borrow().matched.len(), 0);
    assert!(
        world.engines[0]
            .discovered()
            .borrow()
            .participants
            .is_empty()
    );
}

#[test]
fn who_says_anything_is_there() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    // Only its announcements are lost; it is asked for acknowledgements, and gives them.
    world.loses = Box::new(|_, bytes| {
        bytes[8] == 2 && bytes.windows(4).any(|ids| ids == EntityId::SPDP_WRITER.0)
    });
    let writer = ends.borrow().matched[0].guid;
    assert_eq!(writer.prefix, GuidPrefix([2; 12]));
    let ours = *world.engines[0]
        .writers
        .keys()
        .find(|entity| !entity.is_builtin())
        .expect("a writer");
    for mark in 0..20 {
        world.write(Guid::new(GuidPrefix([1; 12]), ours), mark, 8);
        world.pass(SECOND);
    }
    assert_eq!(ends.borrow().matched.len(), 1);
}

#[test]
fn whose_port_is_gone_is_dead_at_once() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    world.reader(1, keep(10));
    world.pass(SECOND);
    let now = world.now;
    world.engines[0].ports_bound(now, &bound([7410, 7411, 7412, 7413]));
    assert_eq!(ends.borrow().matched.len(), 1);
    world.engines[0].ports_bound(now, &bound([7410, 7411]));
    assert_eq!(ends.borrow().matched.len(), 0);
}

#[test]
fn a_node_killed_between_two_fragments_leaves_nothing_of_its_sample() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(10));
    let (_, ends, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // It sends one datagram of many.
    let mut sent = 0;
    world.loses = Box::new(move |_, bytes| {
        sent += usize::from(bytes[8] == 1);
        sent > 1
    });
    world.write(writer, 1, 500_000);
    world.carry();
    assert_ne!(world.budget.used(), 0, "a part has come");
    let now = world.now;
    world.engines[1].ports_bound(now, &bound([7412, 7413]));
    assert_eq!(world.budget.used(), 0);
    assert_eq!(ends.borrow().matched.len(), 0);
    // Who takes its place is heard, and nothing of the dead.
    world.loses = Box::new(|_, bytes| bytes[8] == 1);
    world.join();
    let (writer, _) = world.writer(2, keep(10));
    world.pass(SECOND);
    world.write(writer, 7, 8);
    world.pass(SECOND);
    assert_eq!(read.marks(), [7]);
}

#[test]
fn ends_that_are_taken_back_are_gone_there_too() {
    let mut world = World::of(2);
    let (_, ends) = world.writer(0, keep(10));
    let (reader, _, _) = world.reader(1, keep(10));
    world.pass(SECOND);
    assert_eq!(ends.borrow().matched.len(), 1);
    let now = world.now;
    drop(world.engines[1].remove_end(now, reader.entity));
    world.pass(SECOND);
    assert_eq!(ends.borrow().matched.len(), 0);
    world.engines[1].close(world.now);
    world.pass(SECOND / 10);
    assert!(
        world.engines[0]
            .discovered()
            .borrow()
            .participants
            .is_empty()
    );
}

#[test]
fn what_was_written_is_sent_though_the_writer_is_dropped() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(10));
    let (_, ends, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    let mut random = scattered(3);
    world.loses = Box::new(move |_, _| random() % 3 == 0);
    (0..5).for_each(|mark| world.write(writer, mark, 30_000));
    let now = world.now;
    drop(world.engines[0].remove_end(now, writer.entity));
    world.pass(SECOND * 4);
    assert_eq!(read.marks(), [0, 1, 2, 3, 4]);
    assert_eq!(ends.borrow().matched.len(), 0);
}

#[test]
fn a_sample_on_its_way_is_not_said_to_be_gone() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(1));
    world.pass(SECOND);
    // Two fragments of seven are out when the next sample takes its place; the receiver asks for the rest.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.write(writer, 2, 8);
    let ask = wire::NackFrag {
        reader: EntityId::user_reader(1),
        writer: writer.entity,
        number: SequenceNumber(1),
        set: {
            let mut set = crate::FragmentSet::empty(3);
            set.insert(3);
            set
        },
        count: 1,
    };
    let mut datagram = DatagramWriter::new(GuidPrefix([2; 12]));
    datagram.destination(GuidPrefix([1; 12]));
    datagram.nack_frag(&ask);
    let now = world.now;
    world.engines[0].receive(now, HERE, &datagram.finish().into());
    // Nor by a heartbeat, which comes before the rest of it does.
    world.engines[0].tick(now + SECOND);
    world.room = None;
    world.pass(SECOND);
    assert_eq!(read.marks(), [1, 2]);
}

/// How many submessages of a kind a datagram has.
fn count(datagram: &[u8], kind: fn(&wire::Submessage) -> bool) -> usize {
    let parsed = wire::parse(&Bytes::copy_from_slice(datagram));
    let submessages = parsed.received.iter().map(|it| &it.submessage);
    submessages.filter(|it| kind(it)).count()
}

#[test]
fn what_is_under_way_is_not_sent_again_for_a_receiver_that_asks_in_the_middle() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(5));
    let (_, _, read) = world.reader(1, keep(5));
    world.pass(SECOND);
    let counted = Arc::new(Mutex::new((0, 0)));
    let counts = Arc::clone(&counted);
    world.loses = Box::new(move |_, datagram| {
        let mut counts = counts.lock();
        counts.0 += count(datagram, |it| matches!(it, wire::Submessage::DataFrag(_)));
        counts.1 += count(datagram, |it| matches!(it, wire::Submessage::NackFrag(_)));
        false
    });
    // Two fragments of seven are out when the receiver is asked what it has, four when it answers, and six when that comes.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.now += SECOND;
    let now = world.now;
    world.engines[0].tick(now);
    world.carry();
    world.engines[1].tick(now + SECOND);
    world.carry();
    assert_eq!(*counted.lock(), (6, 1));
    world.room = None;
    world.pass(SECOND);
    assert_eq!(read.marks(), [1]);
    assert_eq!(counted.lock().0, 7, "each fragment is sent once");
}

/// Fast DDS 2.14.5 takes a number of the set of a GAP for the one at its base: where that is a sample of which it has fragments, it forgets it
/// by half, and whoever takes from that reader then tries for ever.
#[test]
fn numbers_that_will_never_come_are_told_without_a_set() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(1));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    // 2 and 4 are replaced before they are begun, and part of 3 is out.
    world.room = Some(33_000);
    world.write(writer, 1, 100_000);
    world.carry();
    world.write(writer, 2, 100_000);
    world.write(writer, 3, 100_000);
    for _ in 0..4 {
        world.carry();
    }
    world.write(writer, 4, 100_000);
    world.write(writer, 5, 100_000);
    let mut set = SequenceSet::empty(SequenceNumber(2));
    set.insert(SequenceNumber(2));
    set.insert(SequenceNumber(4));
    let ask = wire::AckNack {
        reader: read_by(&world, writer),
        writer: writer.entity,
        set,
        count: 1000,
        is_final: true,
    };
    let mut datagram = DatagramWriter::new(GuidPrefix([2; 12]));
    datagram.destination(GuidPrefix([1; 12]));
    datagram.acknack(&ask);
    let now = world.now;
    world.engines[0].receive(now, HERE, &datagram.finish().into());
    let mut gaps = Vec::new();
    while let Some(datagram) = world.engines[0].control.pop_front() {
        let bytes: Bytes = datagram.head.into();
        for received in wire::parse(&bytes).received {
            if let wire::Submessage::Gap(gap) = received.submessage {
                assert!(gap.set.is_empty(), "{gap:?}");
                gaps.push(gap.start.0..gap.set.base.0);
            }
        }
    }
    assert_eq!(gaps, [2..3, 4..5]);
    // The reader's own words count anew after three seconds.
    world.room = None;
    world.pass(SECOND * 4);
    assert_eq!(read.marks(), [1, 3, 5]);
}

/// The reader that a writer is matched with.
fn read_by(world: &World, writer: Guid) -> EntityId {
    let ends = world.engines[0].writers[&writer.entity].ends.borrow();
    ends.matched[0].guid.entity
}

#[test]
fn a_slow_receiver_gets_whole_samples_though_newer_ones_replace_them() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(
        0,
        EndpointQos {
            history: History::KeepLast(1),
            ..best_effort()
        },
    );
    let (_, _, read) = world.reader(1, best_effort());
    world.pass(SECOND);
    // Two fragments pass between two samples of seven.
    world.room = Some(33_000);
    for mark in 0..40 {
        world.write(writer, mark, 100_000);
        world.carry();
    }
    world.room = None;
    world.pass(SECOND);
    let marks = read.marks();
    assert!(marks.len() >= 8, "{marks:?}");
    assert_eq!(marks.last(), Some(&39));
    assert!(marks.is_sorted_by(|before, after| before < after));
}

#[test]
fn a_reader_that_never_acknowledges_costs_no_more_than_the_depth() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(4));
    let (_, _, read) = world.reader(1, keep(4));
    world.pass(SECOND);
    world.loses = Box::new(|_, _| true);
    for mark in 0..10 {
        world.write(writer, mark, 8);
    }
    world.carry();
    assert_eq!(world.engines[0].dropped(writer.entity), 6);
    world.loses = Box::new(|_, _| false);
    world.pass(SECOND);
    assert_eq!(read.marks(), [6, 7, 8, 9]);
}

#[test]
fn requests_and_replies_keep_their_identity() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(10));
    let (_, _, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    let related = SampleIdentity {
        writer,
        number: SequenceNumber(7),
    };
    let now = world.now;
    for length in [8, 50_000] {
        world.engines[0].write(now, writer.entity, vec![0; length].into(), Some(related));
    }
    world.pass(SECOND);
    let told: Vec<_> = read.0.lock().iter().map(|sample| sample.related).collect();
    assert_eq!(told, [Some(related), Some(related)]);
}

#[test]
fn datagrams_of_nonsense_change_nothing() {
    let mut world = World::of(2);
    let (writer, _) = world.writer(0, keep(10));
    let (_, ends, read) = world.reader(1, keep(10));
    world.pass(SECOND);
    let mut kept: Vec<Bytes> = Vec::new();
    for mark in 0..4 {
        world.write(writer, mark, 40_000);
        while let Some(datagram) = world.engines[0].transmit(&mut |_, _, _| true) {
            kept.push(
                datagram
                    .parts()
                    .iter()
                    .flat_map(|part| part.to_vec())
                    .collect(),
            );
        }
    }
    let mut random = scattered(7);
    let now = world.now;
    for _ in 0..20_000 {
        let mut bytes = kept[random() as usize % kept.len()].to_vec();
        // Never the sender: who says to be somebody else is believed, as there is no security.
        for _ in 0..1 + random() % 8 {
            let at = 20 + random() as usize % (bytes.len().min(200) - 20);
            bytes[at] = random() as u8;
        }
        bytes.truncate(20 + random() as usize % bytes.len());
        world.engines[1].receive(now, HERE, &bytes.into());
        world.engines[1].take_deliveries();
    }
    assert_eq!(ends.borrow().matched.len(), 1);
    drop(read);
}

#[test]
fn a_hundred_topics_are_known_soon() {
    let mut world = World::of(2);
    let mut sinks = Vec::new();
    for number in 0..100 {
        let topic = Topic {
            name: format!("rt/topic{number}"),
            ..topic()
        };
        let now = world.now;
        let read = Arc::new(Read::default());
        world.engines[0].add_writer(now, &topic, keep(10));
        world.engines[1].add_reader(now, &topic, keep(10), read.clone());
        sinks.push(read);
    }
    world.pass(SECOND / 4);
    let ours = world.engines[0]
        .writers
        .iter()
        .filter(|(entity, _)| !entity.is_builtin());
    let confirmed = ours.filter(|(_, writer)| writer.ends.borrow().confirmed.len() == 1);
    assert_eq!(confirmed.count(), 100);
}
