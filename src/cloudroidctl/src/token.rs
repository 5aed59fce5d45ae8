//! `token`: who may use the daemon, and as what.

use std::time::Duration;

use api::access::{NewToken, Secret, Token};

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};

/// Tokens: make them for people and robots, list, revoke and rotate them.
#[derive(Debug, clap::Args)]
pub struct Tokens {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    Create(Create),
    List(List),
    Revoke(Revoke),
    Rotate(Rotate),
}

/// Make a token and print it: this once.
#[derive(Debug, clap::Args)]
struct Create {
    /// Name of whoever it is for: rules of the policy and records know it by this.
    name: String,
    /// What it is for: admin (everything), operator (everything but tokens and policy), deployer (publishes services, and does
    /// what it likes with its own), robot (connects as one robot), viewer (reads).
    #[arg(long)]
    role: String,
    /// Service that it is for, or a pattern such as 'lab_*'; may be given several times. '*' is all.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
    /// Id of the robot that it is for; needed with --role robot.
    #[arg(long, value_name = "ID")]
    robot: Option<String>,
    /// Class of the configuration that it may name; may be given several times.
    #[arg(long = "class", value_name = "NAME")]
    classes: Vec<String>,
    /// When it ends, such as 12h or 30d; never by default.
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    expires: Option<Duration>,
}

/// List all tokens there ever were, without their secrets.
#[derive(Debug, clap::Args)]
struct List;

/// End a token; connections that show it are closed.
#[derive(Debug, clap::Args)]
struct Revoke {
    /// Its name.
    name: String,
}

/// Give a token another secret and print it; connections that show the old one are closed.
#[derive(Debug, clap::Args)]
struct Rotate {
    /// Its name.
    name: String,
}

/// `90s`, `30m`, `12h`, `30d`.
pub fn lifetime(text: &str) -> Result<Duration, String> {
    let bad = || "write a whole number with s, m, h or d, such as 30d".to_owned();
    let (number, unit) = text.split_at(text.len() - text.chars().last().map_or(0, char::len_utf8));
    let seconds: u64 = match unit {
        "s" => 1,
        "m" => 60,
        "h" => 3600,
        "d" => 86_400,
        _ => return Err(bad()),
    };
    let number: u64 = number.parse().map_err(|_| bad())?;
    let length = number.checked_mul(seconds).filter(|length| *length > 0);
    length.map(Duration::from_secs).ok_or_else(bad)
}

pub fn patterns(texts: &[String]) -> anyhow::Result<Vec<access::Glob>> {
    Ok(texts
        .iter()
        .map(|text| text.parse())
        .collect::<Result<_, _>>()?)
}

impl Tokens {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        match self.verb {
            Verb::Create(verb) => {
                let new = NewToken {
                    role: verb.role.parse()?,
                    services: patterns(&verb.services)?,
                    classes: patterns(&verb.classes)?,
                    robot: verb.robot,
                    lifetime: verb.expires.map(|length| length.as_secs()),
                    name: verb.name,
                };
                told(&client.post("/api/v1/tokens", &new).await?, format)
            }
            Verb::List(List) => {
                let tokens: Vec<Token> = client.get("/api/v1/tokens").await?;
                list(&tokens, format)
            }
            Verb::Revoke(verb) => {
                let path = format!("/api/v1/tokens/{}", escaped(&verb.name));
                let tokens: Vec<Token> = client.delete(&path).await?;
                match format {
                    Format::Json => output::json(&tokens),
                    Format::Table => output::line(&format!("token {} is revoked", verb.name)),
                }
            }
            Verb::Rotate(verb) => {
                let path = format!("/api/v1/tokens/{}/rotate", escaped(&verb.name));
                told(&client.post(&path, &()).await?, format)
            }
        }
    }
}

/// The secret alone on standard output, so that it can be taken from there; the rest beside it.
fn told(made: &Secret, format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(made);
    }
    let Token { name, role, .. } = &made.token;
    output::complain(&format!(
        "the token of {name} ({role}) follows; it is shown this once, and only its hash is kept"
    ));
    output::line(&made.secret)
}

fn list(tokens: &[Token], format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(&tokens);
    }
    let mut table = Table::new(&[
        "NAME", "ROLE", "SERVICES", "ROBOT", "CLASSES", "AGE", "USED", "STATE",
    ]);
    for token in tokens {
        let texts = |patterns: &[access::Glob]| match patterns {
            [] => "-".to_owned(),
            patterns => patterns
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(","),
        };
        table.row([
            token.name.clone(),
            token.role.to_string(),
            texts(&token.services),
            token.robot.clone().unwrap_or_else(|| "-".into()),
            texts(&token.classes),
            output::age(token.created),
            token
                .last_used
                .map_or_else(|| "never".into(), |at| format!("{} ago", output::age(at))),
            state(token),
        ]);
    }
    match table.is_empty() {
        true => output::line(
            "there are no tokens; make one with: cloudroidctl token create NAME --role ROLE",
        ),
        false => table.print(),
    }
}

fn state(token: &Token) -> String {
    match (token.revoked, token.expires) {
        (Some(at), _) => format!("revoked {} ago", output::age(at)),
        (None, None) => "good".into(),
        (None, Some(end)) if output::is_past(end) => format!("expired {} ago", output::age(end)),
        (None, Some(end)) => format!("ends in {}", output::until(end)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lifetimes_are_read() {
        for (text, seconds) in [
            ("90s", 90),
            ("2m", 120),
            ("12h", 43_200),
            ("30d", 2_592_000),
        ] {
            assert_eq!(lifetime(text), Ok(Duration::from_secs(seconds)), "{text}");
        }
        for text in [
            "",
            "30",
            "d",
            "0d",
            "1.5h",
            "-1d",
            "1w",
            "99999999999999999999d",
            "9999999999999999999d",
            "1ä",
        ] {
            lifetime(text).expect_err(text);
        }
    }
}
