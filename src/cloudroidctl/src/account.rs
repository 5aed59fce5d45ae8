//! `account`: people who sign in with a password.

mod password;

use api::people::{Account, AccountChange, NewAccount, SessionLine};

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};

/// Accounts: people who sign in to the portal's page with a name and a password.
#[derive(Debug, clap::Args)]
pub struct Accounts {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    Create(Create),
    List(List),
    Passwd(Passwd),
    Role(Role),
    Disable(Disable),
    Enable(Enable),
    Remove(Remove),
    Sessions(Sessions),
    Logout(Logout),
}

/// Make an account; its password is asked for.
#[derive(Debug, clap::Args)]
struct Create {
    /// Name of the person: rules of the policy and records know it by this.
    name: String,
    /// What it is for: admin (everything), operator (everything but accounts, tokens and policy), deployer (publishes services, and
    /// does what it likes with its own), viewer (reads).
    #[arg(long)]
    role: String,
    /// Service that it is for, or a pattern such as 'lab_*'; may be given several times. '*' is all.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
    /// Read the password from standard input, up to the end of its first line.
    #[arg(long)]
    password_stdin: bool,
}

/// List all accounts.
#[derive(Debug, clap::Args)]
struct List;

/// Set another password; the person is signed out everywhere.
#[derive(Debug, clap::Args)]
struct Passwd {
    /// Its name.
    name: String,
    /// Read the password from standard input, up to the end of its first line.
    #[arg(long)]
    password_stdin: bool,
}

/// Give a person another role and scope; it is signed out everywhere.
#[derive(Debug, clap::Args)]
struct Role {
    /// Its name.
    name: String,
    /// admin, operator, deployer or viewer.
    role: String,
    /// Service that it is for, or a pattern; may be given several times. '*' is all.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
}

/// Let a person sign in no more; it is signed out everywhere.
#[derive(Debug, clap::Args)]
struct Disable {
    /// Its name.
    name: String,
}

/// Let a person sign in again.
#[derive(Debug, clap::Args)]
struct Enable {
    /// Its name.
    name: String,
}

/// Remove an account; the person is signed out everywhere.
#[derive(Debug, clap::Args)]
struct Remove {
    /// Its name.
    name: String,
}

/// List who is signed in, and from where.
#[derive(Debug, clap::Args)]
struct Sessions {
    /// Of this person alone; oidc:NAME of somebody whom the identity provider knows.
    name: Option<String>,
}

/// Sign a person out everywhere.
#[derive(Debug, clap::Args)]
struct Logout {
    /// Its name; oidc:NAME of somebody whom the identity provider knows.
    name: String,
}

fn patterns(texts: &[String]) -> anyhow::Result<Vec<access::Glob>> {
    let patterns = texts.iter().map(|text| text.parse());
    Ok(patterns.collect::<Result<_, _>>()?)
}

fn path(name: &str) -> String {
    format!("/api/v1/accounts/{}", escaped(name))
}

impl Accounts {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        match self.verb {
            Verb::Create(verb) => {
                let new = NewAccount {
                    role: verb.role.parse()?,
                    services: patterns(&verb.services)?,
                    password: password::read(verb.password_stdin)?,
                    name: verb.name,
                };
                let all = client.post("/api/v1/accounts", &new).await?;
                done(all, format, &format!("account {} is made", new.name))
            }
            Verb::List(List) => list(
                &client.get::<Vec<Account>>("/api/v1/accounts").await?,
                format,
            ),
            Verb::Passwd(verb) => {
                let change = AccountChange {
                    password: Some(password::read(verb.password_stdin)?),
                    ..AccountChange::default()
                };
                let all = client.patch(&path(&verb.name), &change).await?;
                done(all, format, &format!("{} has another password", verb.name))
            }
            Verb::Role(verb) => {
                let change = AccountChange {
                    role: Some(verb.role.parse()?),
                    services: patterns(&verb.services)?,
                    ..AccountChange::default()
                };
                let all = client.patch(&path(&verb.name), &change).await?;
                done(
                    all,
                    format,
                    &format!("{} has the role {}", verb.name, verb.role),
                )
            }
            Verb::Disable(Disable { name }) => {
                let all = set_disabled(client, &name, true).await?;
                done(all, format, &format!("{name} cannot sign in any more"))
            }
            Verb::Enable(Enable { name }) => {
                let all = set_disabled(client, &name, false).await?;
                done(all, format, &format!("{name} can sign in"))
            }
            Verb::Remove(Remove { name }) => {
                let all = client.delete(&path(&name)).await?;
                done(all, format, &format!("account {name} is removed"))
            }
            Verb::Sessions(Sessions { name }) => {
                let mut all: Vec<SessionLine> = client.get("/api/v1/sessions").await?;
                all.retain(|line| name.as_ref().is_none_or(|name| line.name == *name));
                list_sessions(&all, format)
            }
            Verb::Logout(Logout { name }) => {
                let path = format!("{}/sessions", path(&name));
                let all: Vec<SessionLine> = client.delete(&path).await?;
                match format {
                    Format::Json => output::json(&all),
                    Format::Table => output::line(&format!("{name} is signed out everywhere")),
                }
            }
        }
    }
}

async fn set_disabled(client: &Client, name: &str, disabled: bool) -> anyhow::Result<Vec<Account>> {
    let change = AccountChange {
        disabled: Some(disabled),
        ..AccountChange::default()
    };
    client.patch(&path(name), &change).await
}

fn done(all: Vec<Account>, format: Format, words: &str) -> anyhow::Result<()> {
    match format {
        Format::Json => output::json(&all),
        Format::Table => output::line(words),
    }
}

fn list(accounts: &[Account], format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(&accounts);
    }
    let mut table = Table::new(&[
        "NAME",
        "ROLE",
        "SERVICES",
        "AGE",
        "SIGNED IN",
        "SESSIONS",
        "STATE",
    ]);
    for account in accounts {
        let services: Vec<String> = account.services.iter().map(ToString::to_string).collect();
        let last = account.last_login;
        table.row([
            account.name.clone(),
            account.role.to_string(),
            services.join(","),
            output::age(account.created),
            last.map_or_else(|| "never".into(), |at| format!("{} ago", output::age(at))),
            account.sessions.to_string(),
            account.disabled.map_or_else(
                || "good".into(),
                |at| format!("disabled {} ago", output::age(at)),
            ),
        ]);
    }
    match table.is_empty() {
        true => output::line(
            "there are no accounts; make one with: cloudroidctl account create NAME --role ROLE",
        ),
        false => table.print(),
    }
}

fn list_sessions(sessions: &[SessionLine], format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(&sessions);
    }
    let mut table = Table::new(&["NAME", "ROLE", "FROM", "AGE", "USED", "STATE"]);
    for session in sessions {
        table.row([
            session.name.clone(),
            session.role.to_string(),
            session.from.clone(),
            output::age(session.created),
            format!("{} ago", output::age(session.last_used)),
            format!("ends in {}", output::until(session.expires)),
        ]);
    }
    match table.is_empty() {
        true => output::line("nobody is signed in"),
        false => table.print(),
    }
}
