//! `foreframe keys`

use std::time::SystemTime;

use super::settings::{StoreSettings, open_store};
use super::{CliError, say};
use crate::server::keys::NewKey;
use crate::store::{KeyRow, Store};

/// Make, list and revoke the keys that callers of a server show.
///
/// A server that can be reached from other machines asks for a key: the header Authorization: Bearer KEY. A running server
/// takes a change within seconds.
#[derive(clap::Args)]
#[command(after_help = "Example: foreframe keys create robot-7")]
pub(super) struct KeysArgs {
    #[command(subcommand)]
    action: KeysCommand,
    #[command(flatten)]
    settings: StoreSettings,
}

#[derive(clap::Subcommand)]
enum KeysCommand {
    /// Make a key and print it: only its hash is kept, so it is never seen again
    Create {
        /// Whose it is, for the list
        name: String,
    },
    /// List the keys: id, name, since when, and whether they are revoked
    List,
    /// Take a key's right away
    Revoke {
        /// The key's id, as in the list
        id: String,
    },
}

pub(super) fn run(args: &KeysArgs) -> Result<(), CliError> {
    let config = args.settings.load()?.config;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    runtime.block_on(async {
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
        return Err(CliError::Usage("a key's name is a line of 1 to 64 bytes".to_owned()));
    }
    let key = NewKey::generate().map_err(CliError::failed)?;
    store.create_key(&key.id, name, &key.hash, unix_s()).await?;
    say(key.text)
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
        let age_days = (unix_s() - created_s) / 86_400.0;
        say(format!("{id}  {state:7}  {age_days:6.1} days old  {name}"))?;
    }
    Ok(())
}

async fn revoke(store: &Store, id: &str) -> Result<(), CliError> {
    if store.revoke_key(id, unix_s()).await? {
        let is_last = store.list_keys().await?.iter().all(|key| key.revoked_s.is_some());
        let then = if is_last {
            "; it was the last: nobody may call until another is made"
        } else {
            ""
        };
        return say(format!("{id} is revoked{then}"));
    }
    Err(CliError::Usage(format!(
        "there is no valid key {id}; foreframe keys list names them"
    )))
}

fn unix_s() -> f64 {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since_1970.unwrap_or_default().as_secs_f64()
}
