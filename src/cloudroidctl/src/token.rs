//! `token`: bearer tokens for the daemon and their roles.

use std::time::Duration;

use anyhow::{Context, bail};
use api::access::{NewToken, Secret, Token};

use crate::client::{DaemonClient, percent_encode};
use crate::confirm::YesFlag;
use crate::first_credential::confirm_first_credential;
use crate::output::{self, OutputFormat, Table};

/// Manage tokens of people and robots: create, list, revoke and rotate them.
#[derive(Debug, clap::Args)]
pub struct TokenArgs {
    #[command(subcommand)]
    verb: TokenCommand,
}

#[derive(Debug, clap::Subcommand)]
enum TokenCommand {
    Create(CreateToken),
    List(ListTokens),
    Revoke(RevokeToken),
    Rotate(RotateToken),
}

/// Create a token and print it, this once only.
#[derive(Debug, clap::Args)]
struct CreateToken {
    /// Name of the holder, as it appears in policy rules and in the audit log.
    name: String,
    /// Role: admin (everything), operator (everything but tokens and policy), deployer (publishes services and manages
    /// its own), robot (connects as one robot), viewer (reads).
    #[arg(long)]
    role: String,
    /// Service that the token is limited to, or a pattern such as 'lab_*' ('*' for all); may be given several times.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
    /// Id of the robot; required with --role robot.
    #[arg(long, value_name = "ID")]
    robot: Option<String>,
    /// Class that the robot may name; may be given several times.
    #[arg(long = "class", value_name = "NAME")]
    classes: Vec<String>,
    /// Lifetime of the token, such as 12h or 30d (default: unlimited).
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    expires: Option<Duration>,
    #[command(flatten)]
    yes: YesFlag,
}

/// List all tokens, including revoked ones, without their secrets.
#[derive(Debug, clap::Args)]
struct ListTokens;

/// Revoke a token; its connections are closed.
#[derive(Debug, clap::Args)]
struct RevokeToken {
    /// Name of the token.
    name: String,
}

/// Replace the secret of a token and print it; connections with the old one are closed.
#[derive(Debug, clap::Args)]
struct RotateToken {
    /// Name of the token.
    name: String,
}

/// Parses `90s`, `30m`, `12h` or `30d`.
pub fn lifetime(text: &str) -> anyhow::Result<Duration> {
    const ADVICE: &str = "write a whole number with s, m, h or d, such as 30d";
    let (number, unit) = text.split_at(text.len() - text.chars().last().map_or(0, char::len_utf8));
    let seconds: u64 = match unit {
        "s" => 1,
        "m" => 60,
        "h" => 3600,
        "d" => 86_400,
        _ => bail!(ADVICE),
    };
    let number: Option<u64> = number.parse().ok();
    let length = number.and_then(|number| number.checked_mul(seconds));
    let length = length.filter(|length| *length > 0).context(ADVICE)?;
    Ok(Duration::from_secs(length))
}

/// Parses patterns of services or classes.
pub fn parse_patterns(texts: &[String]) -> anyhow::Result<Vec<access::Glob>> {
    Ok(texts.iter().map(|text| text.parse()).collect::<Result<_, _>>()?)
}

impl TokenArgs {
    /// Sends the requests and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb {
            TokenCommand::Create(verb) => {
                let new = NewToken {
                    role: verb.role.parse()?,
                    services: parse_patterns(&verb.services)?,
                    classes: parse_patterns(&verb.classes)?,
                    robot: verb.robot,
                    lifetime: verb.expires.map(|length| length.as_secs()),
                    name: verb.name,
                };
                confirm_first_credential(client, verb.yes).await?;
                print_secret(&client.post("/api/v1/tokens", &new).await?, format)
            }
            TokenCommand::List(ListTokens) => {
                let tokens: Vec<Token> = client.get("/api/v1/tokens").await?;
                list(&tokens, format)
            }
            TokenCommand::Revoke(verb) => {
                let path = format!("/api/v1/tokens/{}", percent_encode(&verb.name));
                let tokens: Vec<Token> = client.delete(&path).await?;
                match format {
                    OutputFormat::Json => output::json(&tokens),
                    OutputFormat::Table => output::line(&format!("token {} is revoked", verb.name)),
                }
            }
            TokenCommand::Rotate(verb) => {
                let path = format!("/api/v1/tokens/{}/rotate", percent_encode(&verb.name));
                print_secret(&client.post(&path, &()).await?, format)
            }
        }
    }
}

/// Prints only the secret to standard output, so that it can be piped, and everything else to standard error.
fn print_secret(made: &Secret, format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(made);
    }
    let Token { name, role, .. } = &made.token;
    output::eprint_line(&format!(
        "the token of {name} ({role}) follows; it is shown only once, and the server keeps only its hash"
    ));
    output::line(&made.secret)
}

fn list(tokens: &[Token], format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(&tokens);
    }
    let mut table = Table::new(&["NAME", "ROLE", "SERVICES", "ROBOT", "CLASSES", "AGE", "USED", "STATE"]);
    for token in tokens {
        table.row([
            token.name.clone(),
            token.role.to_string(),
            output::patterns(&token.services),
            token.robot.clone().unwrap_or_else(|| "-".into()),
            output::patterns(&token.classes),
            output::age(token.created),
            output::last_use(token.last_used),
            state(token),
        ]);
    }
    table.print_list("no tokens; create one with: cloudroidctl token create NAME --role ROLE")
}

fn state(token: &Token) -> String {
    match (token.revoked, token.expires) {
        (Some(at), _) => format!("revoked {} ago", output::age(at)),
        (None, None) => "active".into(),
        (None, Some(end)) if output::is_past(end) => format!("expired {} ago", output::age(end)),
        (None, Some(end)) => format!("expires in {}", output::time_until(end)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lifetimes_are_read() {
        for (text, seconds) in [("90s", 90), ("2m", 120), ("12h", 43_200), ("30d", 2_592_000)] {
            let length = lifetime(text).expect(text);
            assert_eq!(length, Duration::from_secs(seconds), "{text}");
        }
        for text in ["", "30", "d", "0d", "1.5h", "-1d", "1w", "99999999999999999999d", "9999999999999999999d", "1ä"] {
            lifetime(text).expect_err(text);
        }
    }
}
