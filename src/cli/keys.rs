//! `foreframe keys`

use super::settings::{CommonArgs, open_store};
use super::workspace::block_on;
use super::{CliError, print_line};
use crate::server::keys::NewKey;
use crate::store::{KeyRow, Store, unix_s};

const SECONDS_PER_DAY: f64 = 86_400.0;

/// Create, list and revoke API keys.
///
/// A server that other machines can reach, or for which a key exists, asks for a key in the header `Authorization: Bearer KEY`.
/// A running server applies changes within seconds.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe keys create robot-7
  foreframe keys list
  foreframe keys revoke 5f0c2ab91d34")]
pub(super) struct KeysArgs {
    #[command(subcommand)]
    action: KeysCommand,
    #[command(flatten)]
    settings: CommonArgs,
}

#[derive(clap::Subcommand)]
enum KeysCommand {
    /// Create a key and print it. Only its hash is stored, so it cannot be shown again
    #[command(after_help = "Example:\n  foreframe keys create robot-7 --data-dir /var/lib/foreframe")]
    Create {
        /// Who will use it; for the list
        name: String,
    },
    /// List the keys: id, state, age, name
    #[command(after_help = "Example:\n  foreframe keys list")]
    List,
    /// Revoke a key: requests with it are refused
    #[command(after_help = "Example:\n  foreframe keys revoke 5f0c2ab91d34")]
    Revoke {
        /// The key's id, as in the list
        id: String,
    },
}

pub(super) fn run(args: &KeysArgs) -> Result<(), CliError> {
    let config = args.settings.start()?;
    block_on(async {
        let store = open_store(&config).await?;
        match &args.action {
            KeysCommand::Create { name } => create(&store, name).await,
            KeysCommand::List => list(&store).await,
            KeysCommand::Revoke { id } => revoke(&store, id).await,
        }
    })
}

async fn create(store: &Store, name: &str) -> Result<(), CliError> {
    if name.is_empty() || name.len() > 64 || name.chars().any(char::is_control) {
        return Err(CliError::Usage(format!(
            "{name:?} is not a name for a key; use one line of 1 to 64 bytes"
        )));
    }
    let key = NewKey::generate().map_err(CliError::failed)?;
    store.create_key(&key.id, name, &key.hash, unix_s()).await?;
    print_line(key.text)
}

async fn list(store: &Store) -> Result<(), CliError> {
    for KeyRow {
        id,
        name,
        created_s,
        revoked_s,
        ..
    } in store.list_keys().await?
    {
        let state = if revoked_s.is_some() { "revoked" } else { "valid" };
        let age_days = (unix_s() - created_s) / SECONDS_PER_DAY;
        print_line(format!("{id}  {state:7}  {age_days:6.1} days old  {name}"))?;
    }
    Ok(())
}

async fn revoke(store: &Store, id: &str) -> Result<(), CliError> {
    if store.revoke_key(id, unix_s()).await? {
        let is_last = store.list_keys().await?.iter().all(|key| key.revoked_s.is_some());
        let consequence = if is_last {
            "; it was the last valid key: every request is refused until another is created"
        } else {
            ""
        };
        return print_line(format!("{id} is revoked{consequence}"));
    }
    Err(CliError::Usage(format!(
        "there is no valid key {id}; foreframe keys list lists them"
    )))
}
