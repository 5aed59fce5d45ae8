//! Colours of states, for terminals.

use std::io::IsTerminal;

/// A colour for text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colour {
    /// Fine.
    Green,
    /// Deserves attention.
    Yellow,
    /// Failed.
    Red,
    /// Minor detail.
    Dim,
}

/// Returns whether colours are written to this stream: a terminal that has them, unless `NO_COLOR` is set
/// (no-color.org).
pub fn has_colours(stream: &impl IsTerminal) -> bool {
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let is_dumb = std::env::var_os("TERM").is_some_and(|name| name == "dumb");
    stream.is_terminal() && !is_set("NO_COLOR") && !is_dumb
}

/// Returns the text in a colour. The caller has checked [`has_colours`].
pub fn paint(text: &str, colour: Colour) -> String {
    let code = match colour {
        Colour::Green => 32,
        Colour::Yellow => 33,
        Colour::Red => 31,
        Colour::Dim => 2,
    };
    format!("\x1b[{code}m{text}\x1b[0m")
}

/// Returns the colour of a state by its first word; `None` for a state that is neither good nor bad.
pub fn colour_of_state(state: &str) -> Option<Colour> {
    let (word, more) = state.split_at(state.find(|c: char| !c.is_alphanumeric()).unwrap_or(state.len()));
    let colour = match word {
        "ready" | "active" | "ok" | "promoted" | "paired" | "online" => Colour::Green,
        "requested" | "admitted" | "created" | "starting" | "draining" | "waiting" | "pending" | "warning" => {
            Colour::Yellow
        }
        "failed" | "MISSING" | "revoked" | "expired" | "disabled" | "refused" => Colour::Red,
        _ => return None,
    };
    // "ready: /node failed 3 times": it runs, and something is wrong.
    Some(if colour == Colour::Green && more.starts_with(':') { Colour::Yellow } else { colour })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_has_the_colour_of_its_first_word() {
        for (state, colour) in [
            ("ready", Some(Colour::Green)),
            ("ready (idle)", Some(Colour::Green)),
            ("ready: /talker failed 3 times in a row", Some(Colour::Yellow)),
            ("starting", Some(Colour::Yellow)),
            ("failed: out of memory", Some(Colour::Red)),
            ("revoked 3 s ago", Some(Colour::Red)),
            ("expires in 3 s", None),
            ("", None),
        ] {
            assert_eq!(colour_of_state(state), colour, "{state}");
        }
        assert_eq!(paint("x", Colour::Red), "\x1b[31mx\x1b[0m");
    }
}
