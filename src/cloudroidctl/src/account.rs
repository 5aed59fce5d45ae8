//! `account`: accounts of people who sign in with a password.

pub mod password;

use api::people::{Account, AccountChange, NewAccount, SessionLine};

use crate::client::{DaemonClient, percent_encode};
use crate::confirm::YesFlag;
use crate::first_credential::confirm_first_credential;
use crate::output::{self, OutputFormat, Table};
use crate::token::parse_patterns;

/// Manage accounts: people who sign in to the portal's page with a name and a password.
#[derive(Debug, clap::Args)]
pub struct AccountArgs {
    #[command(subcommand)]
    verb: AccountCommand,
}

#[derive(Debug, clap::Subcommand)]
enum AccountCommand {
    Create(CreateAccount),
    List(ListAccounts),
    Passwd(ChangePassword),
    Role(ChangeRole),
    Disable(DisableAccount),
    Enable(EnableAccount),
    Remove(RemoveAccount),
    Sessions(ListSessions),
    Logout(LogoutAccount),
}

/// Create an account; asks for its password.
#[derive(Debug, clap::Args)]
struct CreateAccount {
    /// Name of the person, as it appears in policy rules and in the audit log.
    name: String,
    /// Role: admin (everything), operator (everything but accounts, tokens and policy), deployer (publishes services
    /// and manages its own), viewer (reads).
    #[arg(long)]
    role: String,
    /// Service that the role is limited to, or a pattern such as 'lab_*' ('*' for all); may be given several times.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
    /// Read the password from the first line of standard input.
    #[arg(long)]
    password_stdin: bool,
    #[command(flatten)]
    yes: YesFlag,
}

/// List all accounts.
#[derive(Debug, clap::Args)]
struct ListAccounts;

/// Change the password of an account; signs the person out everywhere.
#[derive(Debug, clap::Args)]
struct ChangePassword {
    /// Name of the account.
    name: String,
    /// Read the password from the first line of standard input.
    #[arg(long)]
    password_stdin: bool,
}

/// Change the role and the services of an account; signs the person out everywhere.
#[derive(Debug, clap::Args)]
struct ChangeRole {
    /// Name of the account.
    name: String,
    /// Role: admin, operator, deployer or viewer.
    role: String,
    /// Service that the role is limited to, or a pattern ('*' for all); may be given several times.
    #[arg(long = "service", value_name = "NAME")]
    services: Vec<String>,
}

/// Disable an account: the person is signed out everywhere and cannot sign in again.
#[derive(Debug, clap::Args)]
struct DisableAccount {
    /// Name of the account.
    name: String,
}

/// Enable a disabled account.
#[derive(Debug, clap::Args)]
struct EnableAccount {
    /// Name of the account.
    name: String,
}

/// Remove an account; signs the person out everywhere.
#[derive(Debug, clap::Args)]
struct RemoveAccount {
    /// Name of the account.
    name: String,
}

/// List the sessions: who is signed in, and from where.
#[derive(Debug, clap::Args)]
struct ListSessions {
    /// Only sessions of this person; oidc:NAME for a person known by the identity provider.
    name: Option<String>,
}

/// Sign a person out everywhere.
#[derive(Debug, clap::Args)]
struct LogoutAccount {
    /// Name of the account; oidc:NAME for a person known by the identity provider.
    name: String,
}

fn account_path(name: &str) -> String {
    format!("/api/v1/accounts/{}", percent_encode(name))
}

impl AccountArgs {
    /// Sends the requests and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb {
            AccountCommand::Create(verb) => {
                let role: access::Role = verb.role.parse()?;
                let services = parse_patterns(&verb.services)?;
                confirm_first_credential(client, verb.yes).await?;
                let new = NewAccount {
                    role,
                    services,
                    password: password::read_password(verb.password_stdin)?,
                    name: verb.name,
                };
                let all = client.post("/api/v1/accounts", &new).await?;
                print_outcome(all, format, &format!("account {} created", new.name))
            }
            AccountCommand::List(ListAccounts) => list(&client.get::<Vec<Account>>("/api/v1/accounts").await?, format),
            AccountCommand::Passwd(verb) => {
                let change = AccountChange {
                    password: Some(password::read_password(verb.password_stdin)?),
                    ..AccountChange::default()
                };
                let all = client.patch(&account_path(&verb.name), &change).await?;
                print_outcome(all, format, &format!("password of {} changed", verb.name))
            }
            AccountCommand::Role(verb) => {
                let change = AccountChange {
                    role: Some(verb.role.parse()?),
                    services: parse_patterns(&verb.services)?,
                    ..AccountChange::default()
                };
                let all = client.patch(&account_path(&verb.name), &change).await?;
                print_outcome(all, format, &format!("{} now has the role {}", verb.name, verb.role))
            }
            AccountCommand::Disable(DisableAccount { name }) => {
                let all = set_disabled(client, &name, true).await?;
                print_outcome(all, format, &format!("{name} can no longer sign in"))
            }
            AccountCommand::Enable(EnableAccount { name }) => {
                let all = set_disabled(client, &name, false).await?;
                print_outcome(all, format, &format!("{name} can sign in"))
            }
            AccountCommand::Remove(RemoveAccount { name }) => {
                let all = client.delete(&account_path(&name)).await?;
                print_outcome(all, format, &format!("account {name} removed"))
            }
            AccountCommand::Sessions(ListSessions { name }) => {
                let mut all: Vec<SessionLine> = client.get("/api/v1/sessions").await?;
                all.retain(|line| name.as_ref().is_none_or(|name| line.name == *name));
                list_sessions(&all, format)
            }
            AccountCommand::Logout(LogoutAccount { name }) => {
                let path = format!("{}/sessions", account_path(&name));
                let all: Vec<SessionLine> = client.delete(&path).await?;
                match format {
                    OutputFormat::Json => output::json(&all),
                    OutputFormat::Table => output::line(&format!("{name} is signed out everywhere")),
                }
            }
        }
    }
}

async fn set_disabled(client: &DaemonClient, name: &str, disabled: bool) -> anyhow::Result<Vec<Account>> {
    let change = AccountChange { disabled: Some(disabled), ..AccountChange::default() };
    client.patch(&account_path(name), &change).await
}

fn print_outcome(all: Vec<Account>, format: OutputFormat, words: &str) -> anyhow::Result<()> {
    match format {
        OutputFormat::Json => output::json(&all),
        OutputFormat::Table => output::line(words),
    }
}

fn list(accounts: &[Account], format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(&accounts);
    }
    let mut table = Table::new(&["NAME", "ROLE", "SERVICES", "AGE", "SIGNED IN", "SESSIONS", "STATE"]);
    for account in accounts {
        table.row([
            account.name.clone(),
            account.role.to_string(),
            output::patterns(&account.services),
            output::age(account.created),
            output::last_use(account.last_login),
            account.sessions.to_string(),
            account.disabled.map_or_else(|| "active".into(), |at| format!("disabled {} ago", output::age(at))),
        ]);
    }
    table.print_list("no accounts; create one with: cloudroidctl account create NAME --role ROLE")
}

fn list_sessions(sessions: &[SessionLine], format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
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
            format!("expires in {}", output::time_until(session.expires)),
        ]);
    }
    table.print_list("nobody is signed in")
}
