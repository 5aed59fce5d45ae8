use budget::Budget;
use ros::bus::Message;

use super::*;

#[test]
fn a_topic_keeps_the_encodings_of_its_latest_messages_only() {
    let daemon = Budget::new("the daemon", 1 << 30);
    let options = BridgeOptions {
        budget: daemon.within("servant x", 64 << 20),
        ..BridgeOptions::default()
    };
    let metrics = Metrics::default();
    let types = Arc::new(TopicTypes::new(Arc::new(Registry::new())));
    let wire_type = Arc::new(WireType::named("a/B"));
    let topic: Arc<str> = "/t".into();
    let frame = |sample: &Arc<Sample>| {
        sample
            .frame(Compression::CborRaw, &topic, &options, &metrics)
            .unwrap()
    };
    // As they wait for a client that reads slowly.
    let waiting: Vec<_> = (0..40)
        .map(|_| {
            let message = Message {
                bytes: vec![0; 1 << 20].into(),
                wire_type: wire_type.clone(),
                publisher: "/p".into(),
                latching: false,
            };
            let sample = Sample::new(message, false, types.clone(), &options).unwrap();
            let sample = Arc::new(sample);
            frame(&sample);
            sample
        })
        .collect();
    assert!(options.budget.used() <= WARM.1 + (1 << 20));
    assert!(daemon.used() <= (40 << 20) + WARM.1 + (1 << 20));
    assert_eq!(metrics.encoded.get(), 40);
    frame(&waiting[39]);
    assert_eq!(metrics.encoded.get(), 40, "it is still there");
    let late = frame(&waiting[0]);
    assert_eq!(metrics.encoded.get(), 41);
    drop(waiting);
    assert_eq!(options.budget.used(), 0);
    assert_eq!(daemon.used(), late.bytes.len(), "a client is being sent it");
    drop(late);
    assert_eq!(daemon.used(), 0);
}
