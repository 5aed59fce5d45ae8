//! Attempts to exceed the rights of each position in docs/security.md, except that of a servant (see burglary): the
//! responses are checked, and nothing on the server may have changed.

#[path = "breakin/local.rs"]
mod local;
#[path = "breakin/neighbour.rs"]
mod neighbour;
#[path = "breakin/page.rs"]
mod page;
#[path = "breakin/people.rs"]
mod people;
#[path = "breakin/principals.rs"]
mod principals;
#[path = "breakin/scene.rs"]
mod scene;
#[path = "breakin/sockets.rs"]
mod sockets;
#[path = "breakin/wire.rs"]
mod wire;

pub use local::another_account_of_this_machine_reaches_nothing;
pub use neighbour::a_neighbour_gets_no_further_than_the_door;
pub use page::a_page_of_another_site_reaches_nothing_in_a_real_browser;
pub use principals::nobody_gets_beyond_its_role_and_scope;
pub use wire::nothing_is_smuggled_past_who_asks;
