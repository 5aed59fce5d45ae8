use super::*;
use crate::xmlrpc::{print_call, print_fault, print_response};

fn value(xml: &str) -> Result<Value, Error> {
    let document = format!("<methodResponse><params><param>{xml}</param></params></methodResponse>");
    parse_response(document.as_bytes()).map(Result::unwrap)
}

fn reason(result: Result<impl std::fmt::Debug, Error>) -> String {
    result.unwrap_err().to_string()
}

#[test]
fn everything_printed_is_read_back() {
    let all = Value::Struct(BTreeMap::from([
        ("int".to_owned(), Value::Int(-42)),
        ("bool".to_owned(), Value::Bool(true)),
        ("text".to_owned(), Value::from(" <a> & \"b\"\n\tü ]]> ")),
        ("empty".to_owned(), Value::from("")),
        ("double".to_owned(), Value::Double(1e-300)),
        ("infinite".to_owned(), Value::Double(f64::NEG_INFINITY)),
        ("bytes".to_owned(), Value::Base64(vec![0, 255, 7])),
        ("when".to_owned(), Value::DateTime("20240101T00:00:00".into())),
        ("nothing".to_owned(), Value::Nil),
        ("none".to_owned(), Value::Array(vec![])),
        ("list".to_owned(), Value::Array(vec![Value::Struct(BTreeMap::new()), Value::Int(1)])),
        ("odd <name>".to_owned(), Value::Int(i32::MIN)),
    ]));
    let response = print_response(&all);
    assert_eq!(parse_response(response.as_bytes()).unwrap(), Ok(all.clone()));
    let call = print_call("a.b", &[all.clone(), Value::Int(1)]);
    let call = parse_call(call.as_bytes()).unwrap();
    assert_eq!((call.method.as_str(), &call.params[0]), ("a.b", &all));
    let fault = Fault::new("no <way>");
    let printed = print_fault(&fault);
    assert_eq!(parse_response(printed.as_bytes()).unwrap(), Err(fault));
    let not_a_number = print_response(&Value::Double(f64::NAN));
    let read = parse_response(not_a_number.as_bytes()).unwrap().unwrap();
    assert!(matches!(read, Value::Double(number) if number.is_nan()));
}

#[test]
fn what_no_xml_can_hold_spoils_nothing() {
    let printed = print_response(&Value::from("a\0b\u{1b}c"));
    let read = parse_response(printed.as_bytes()).unwrap().unwrap();
    assert_eq!(read, Value::from("a\u{fffd}b\u{fffd}c"));
}

#[test]
fn roscpp_is_understood() {
    // XmlRpcpp omits the type of strings and has its own line breaks.
    let call = b"<?xml version=\"1.0\"?>\r\n<methodCall><methodName>registerPublisher</methodName>\r\n\
        <params><param><value>/node</value></param><param><value></value></param>\
        <param><value>a &lt;b&gt; &amp;&quot;&apos;</value></param>\
        <param><value><i4>7</i4></value></param></params></methodCall>\r\n";
    let call = parse_call(call).unwrap();
    assert_eq!(call.method, "registerPublisher");
    let texts = ["/node", "", "a <b> &\"'"].map(Value::from);
    assert_eq!(call.params[..3], texts);
    assert_eq!(call.params[3], Value::Int(7));
    let empty = "<methodCall><methodName>getPid</methodName></methodCall>";
    assert_eq!(parse_call(empty.as_bytes()).unwrap().params, []);
}

#[test]
fn python_is_understood() {
    let call = b"<?xml version='1.0'?>\n<methodCall>\n<methodName>setParam</methodName>\n<params>\n\
        <param>\n<value><string>/n</string></value>\n</param>\n<param>\n<value><array><data>\n\
        <value><int>1</int></value>\n<value><double>2.5</double></value>\n</data></array></value>\n</param>\n\
        <param>\n<value><struct>\n<member>\n<name>k</name>\n<value><boolean>1</boolean></value>\n</member>\n\
        </struct></value>\n</param>\n<param>\n<value><base64>\nAAEC\n</base64></value>\n</param>\n\
        <param>\n<value><nil/></value></param></params>\n</methodCall>\n";
    let params = parse_call(call).unwrap().params;
    assert_eq!(params[1], Value::Array(vec![Value::Int(1), Value::Double(2.5)]));
    assert_eq!(params[2].get("k"), Some(&Value::Bool(true)));
    assert_eq!(params[3], Value::Base64(vec![0, 1, 2]));
    assert_eq!(params[4], Value::Nil);
}

#[test]
fn odd_but_sound_xml_is_read() {
    assert_eq!(value("<value> \n </value>").unwrap(), Value::from(" \n "));
    let padded = "<value>\n <int> +5 </int>\n</value>";
    assert_eq!(value(padded).unwrap(), Value::Int(5));
    assert_eq!(value("<value/>").unwrap(), Value::from(""));
    assert_eq!(value("<value><string/></value>").unwrap(), Value::from(""));
    let empty = value("<value><array/></value>").unwrap();
    assert_eq!(empty, Value::Array(vec![]));
    let commented = "<value a='>'><!-- <int> --><string><![CDATA[<&]]>&#65;&#x42;&bad;</string ></value >";
    assert_eq!(value(commented).unwrap(), Value::from("<&AB&bad;"));
    let latin = b"<methodResponse><params><param><value>\xe4</value></param></params></methodResponse>";
    assert_eq!(parse_response(latin).unwrap().unwrap(), Value::from("\u{fffd}"));
}

#[test]
fn broken_documents_are_refused_by_name() {
    for (xml, wanted) in [
        ("<value><int>1.5</int></value>", "32-bit integer"),
        ("<value><int>3000000000</int></value>", "32-bit integer"),
        ("<value><int></int></value>", "32-bit integer"),
        ("<value><boolean>2</boolean></value>", "neither 0 nor 1"),
        ("<value><double>x</double></value>", "not a number"),
        ("<value><base64>***</base64></value>", "base64"),
        ("<value><quaternion>1</quaternion></value>", "not known"),
        ("<value>a<int>1</int></value>", "<int> where </value>"),
        ("<value><int>1</int>", "</param> where </value>"),
        ("<value><string>a</int></value>", "</int> where </string>"),
        ("<value><struct><member><value/></member></struct></value>", "<name>"),
        ("<value><array><data><int>1</int></data></array></value>", "<value>"),
        ("<nothing/>", "<value>"),
        ("<value><string>", "</param>"),
        ("<value 'x", "tag"),
        ("<value><!-- ", "missing"),
        ("<value><![CDATA[", "CDATA"),
        ("<value>< >", "no name"),
    ] {
        let reason = reason(value(xml));
        assert!(reason.contains(wanted), "{xml}: {reason}");
    }
    for (document, wanted) in [
        ("", "end of the document"),
        ("hello", "text where"),
        ("<html></html>", "<html>"),
        ("<methodCall><methodName> </methodName></methodCall>", "empty"),
        ("<methodCall><params/></methodCall>", "<methodName>"),
        ("<!DOCTYPE a [<!ENTITY b \"c\">]><methodCall/>", "document type"),
    ] {
        let reason = reason(parse_call(document.as_bytes()));
        assert!(reason.contains(wanted), "{document}: {reason}");
    }
}

#[test]
fn depth_and_number_are_limited() {
    let nested = |depth: usize| {
        let open = "<value><array><data>".repeat(depth);
        let close = "</data></array></value>".repeat(depth);
        value(&format!("{open}{close}"))
    };
    assert_eq!(nested(MAX_DEPTH).unwrap().depth(), MAX_DEPTH);
    assert!(reason(nested(MAX_DEPTH + 1)).contains("deep"));
    assert!(reason(nested(100_000)).contains("deep"));
    let many = "<value/>".repeat(MAX_ELEMENTS);
    let many = value(&format!("<value><array><data>{many}</data></array></value>"));
    assert!(reason(many).contains("values"));
}
