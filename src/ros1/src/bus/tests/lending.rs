use ros_bus::{FailureReason, Lender, LentService};

use super::*;
use crate::master::{Master, MasterOptions};
use crate::testing::args;
use crate::xmlrpc::Value;

/// Lends one service while it is available, and records who looked for what.
#[derive(Default)]
struct Shop {
    on_offer: Mutex<Option<(String, watch::Receiver<bool>)>>,
    asked: Mutex<Vec<(String, String)>>,
}

struct Counter;

#[async_trait]
impl ServiceHandler for Counter {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        match &request[..] {
            b"fail" => Err(FailureReason::new(format!("not for {caller}"))),
            _ => Ok(request),
        }
    }
}

struct Counters(Arc<Shop>);

#[async_trait]
impl Lender for Counters {
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService> {
        let asked = (service.to_owned(), node.to_owned());
        self.0.asked.lock().push(asked);
        let (md5, gone) = self.0.on_offer.lock().clone()?;
        Some(LentService { service_type: ServiceType::new("pkg/Add", md5), handler: Arc::new(Counter), gone })
    }
}

impl Shop {
    fn offers(&self, md5: &str) -> watch::Sender<bool> {
        let (ending, gone) = watch::channel(false);
        *self.on_offer.lock() = Some((md5.to_owned(), gone));
        ending
    }
}

async fn open(master: &TestMaster) -> (Arc<Ros1Bus>, Arc<Shop>) {
    let (keeper, shop) = (join(master, "/keeper").await, Arc::<Shop>::default());
    let lender = Arc::new(Counters(shop.clone()));
    keeper.lend(lender).await.unwrap();
    (keeper, shop)
}

#[tokio::test]
async fn what_nobody_serves_is_lent_and_is_in_no_list() {
    let master = TestMaster::start().await;
    let (_keeper, shop) = open(&master).await;
    let node = join(&master, "/node").await;
    let missing = node.call("/add", "x".into(), PATIENCE).await.unwrap_err();
    assert!(matches!(missing, BusError::NoService(_)), "{missing}");
    let ending = shop.offers("abcd");
    let provider = node.provider("/add").await.unwrap();
    assert_eq!(provider.node, "/keeper");
    assert_eq!(provider.service_type.digest, "abcd");
    assert_eq!(node.call("/add", "1".into(), PATIENCE).await.unwrap(), "1");
    let failed = node.call("/add", "fail".into(), PATIENCE).await.unwrap_err();
    assert!(failed.to_string().contains("not for /node"), "{failed}");
    assert!(master.master.graph().services.is_empty());
    let asked = ("/add".to_owned(), "/node".to_owned());
    assert!(shop.asked.lock().iter().all(|other| *other == asked));
    // A service with another type replaces it: kept connections end, and callers of the first one are told.
    let _second = shop.offers("beef");
    ending.send_replace(true);
    let typed = async |digest: &str| {
        let digest = Digest::from(digest);
        node.call_typed("/add", &digest, "2".into(), PATIENCE).await
    };
    let other = async {
        loop {
            match typed("abcd").await {
                // The kept connection has not ended yet.
                Ok(_) => tokio::task::yield_now().await,
                Err(error) => return error,
            }
        }
    };
    let other = tokio::time::timeout(PATIENCE, other).await.unwrap();
    assert!(matches!(other, BusError::TypeMismatch { .. }), "{other}");
    assert_eq!(typed("beef").await.unwrap(), "2");
}

#[tokio::test]
async fn what_is_registered_comes_first_and_the_lender_asks_for_itself_in_vain() {
    let master = TestMaster::start().await;
    let (keeper, shop) = open(&master).await;
    let _ending = shop.offers("abcd");
    let node = join(&master, "/node").await;
    let own = Arc::new(Counter);
    let of_type = ServiceType::new("pkg/Add", "beef");
    let serving = node.serve("/add", of_type, own).await.unwrap();
    let other = join(&master, "/other").await;
    assert_eq!(other.service_type("/add").await.unwrap().digest, "beef");
    assert!(shop.asked.lock().is_empty(), "{:?}", shop.asked);
    drop(serving);
    master.wait_until(|graph| graph.services.is_empty()).await;
    let missing = keeper.call("/add", "x".into(), PATIENCE).await.unwrap_err();
    assert!(matches!(missing, BusError::NoService(_)), "{missing}");
    assert_eq!(other.service_type("/add").await.unwrap().digest, "abcd");
    // Services looked up in vain are recorded, with the nodes that did.
    assert!(master.master.graph().sought.contains_key("/add"));
}

#[tokio::test]
async fn a_lender_that_is_silent_or_gone_holds_up_nothing_else() {
    let master = TestMaster::start().await;
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}/", silent.local_addr().unwrap());
    let lends = args(["/silent", &uri]);
    assert_eq!(master.call("cloudroid.lendServices", &lends).await.0, 1);
    let lookup = args(["/node", "/add"]);
    let looked_up = master.call("lookupService", &lookup);
    let meanwhile = async {
        // It is asked, and does not answer.
        let asked = silent.accept().await.unwrap();
        for _ in 0..10 {
            let state = master.call("getSystemState", &args(["/node"])).await;
            assert_eq!(state.0, 1);
        }
        let answered = std::time::Instant::now();
        (asked, answered)
    };
    let when = async {
        let found = looked_up.await;
        (found, std::time::Instant::now())
    };
    let ((found, after), (_asked, before)) = tokio::join!(when, meanwhile);
    assert_eq!((found.0, found.1.as_str()), (-1, "no provider"));
    assert!(before < after, "others waited for the lookup");
    drop((silent, _asked));
    // Nobody listens at all, and then another lender is there.
    assert_eq!(master.call("lookupService", &lookup).await.0, -1);
    let (_keeper, shop) = open(&master).await;
    let _ending = shop.offers("abcd");
    assert_eq!(master.call("lookupService", &lookup).await.0, 1);
    let nowhere = args(["/x", "nowhere"]);
    let bad = master.call("cloudroid.lendServices", &nowhere).await;
    assert_eq!(bad.0, -1);
}

#[tokio::test]
async fn another_master_is_told_who_lends() {
    let master = TestMaster::start().await;
    let (_keeper, shop) = open(&master).await;
    let _ending = shop.offers("abcd");
    let address = master.stop().await;
    let again = Master::new(MasterOptions::default());
    let master = TestMaster::start_at(again, Some(address)).await;
    let lookup = args(["/node", "/add"]);
    let found = async { while master.call("lookupService", &lookup).await.0 != 1 {} };
    let found = tokio::time::timeout(PATIENCE, found).await;
    found.expect("the new Master should know the lender");
}

#[tokio::test]
async fn an_ordinary_node_is_no_lender() {
    let master = TestMaster::start().await;
    let node = join(&master, "/node").await;
    let asked = args(["/master", "/add", "/other"]);
    let client = xmlrpc::XmlRpcClient::new(Arc::new(HostSockets), node.uri()).unwrap();
    let answer = client.call("cloudroid.lendService", &asked, PATIENCE).await;
    let answer = answer.unwrap();
    assert_eq!(answer.as_array().unwrap()[0], Value::Int(0));
}
