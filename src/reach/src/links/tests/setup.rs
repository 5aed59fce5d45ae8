use super::*;

#[tokio::test]
async fn a_servant_is_set_up_as_the_stubs_of_another_did_but_with_what_its_own_push_gave() {
    let ((one, its_nodes), (other, other_nodes)) = (hub().await, hub().await);
    assert!(one.read_setup().await.expect("read").nodes.is_empty(), "no stub has started a node");
    let given = |value| vec![("/see/given".to_owned(), ParamValue::Int(value))];
    (*its_nodes.given.lock(), *other_nodes.given.lock()) = (given(1), given(2));
    let _stub = send_hello(&one, &hello("/see", 1)).await;
    let parameters = one.bus.parameters().expect("ROS 1 has them");
    for key in ["/see/own", "/run_id"] {
        parameters.set(key, ParamValue::Int(3)).await.expect("set");
    }
    let setup = one.read_setup().await.expect("read");
    let names: Vec<&str> = setup.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(names, ["/see"]);
    assert_eq!(setup.parameters, [("/see/own".to_owned(), ParamValue::Int(3))]);

    other.apply_setup(&setup).await.expect("applied");
    assert!(other_nodes.is_running("/see").await);
    for (key, value) in [("/see/own", 3), ("/see/given", 2)] {
        assert_eq!(other.bus.parameter(key).await.expect(key), ParamValue::Int(value), "{key}");
    }
}
