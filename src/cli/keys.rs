//! `foreframe keys`

use super::error::CliError;
use super::new_key::{KeyOrder, create_key};
use super::process::print_line;
use super::settings::{CommonArgs, open_store};
use super::workspace::block_on;
use foreframe_jobs::store::{Author, KeyRow, KeyScope, Store};

const SECONDS_PER_DAY: f64 = 86_400.0;

/// Create, list and revoke API keys.
///
/// A server that other machines can reach, or for which a key exists, asks for a key in the header `Authorization: Bearer KEY`.
/// A running server applies changes within seconds.
///
/// A key has a scope. `predict`: predictions, sessions, streams, environments, reading the models. `jobs`: also jobs and data
/// sets. `admin`: also activating and deleting versions, deleting data sets, and the audit trail. Keys that can submit jobs have
/// equal shares of the job queue and take turns.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe keys create robot-7 --scope predict --rate 50
  foreframe keys create student --scope jobs --expires 30d
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
    Create(CreateArgs),
    /// List the keys: id, state, age, scope, limits, name
    #[command(after_help = "Example:\n  foreframe keys list")]
    List,
    /// Revoke a key: requests with it are refused
    #[command(after_help = "Example:\n  foreframe keys revoke 5f0c2ab91d34")]
    Revoke {
        /// The key's id, as in the list, or its name, if no other valid key has it
        key: String,
    },
}

#[derive(clap::Args)]
struct CreateArgs {
    /// Who will use it; for the list
    name: String,
    /// What it allows: predict, jobs or admin
    #[arg(long, default_value_t = KeyScope::Admin)]
    scope: KeyScope,
    /// How long it is valid: a number with s, m, h or d, as in 30d [default: until it is revoked]
    #[arg(long, value_name = "TIME", value_parser = duration_s)]
    expires: Option<f64>,
    /// How many requests a second each server accepts with it; others get 429 [default: no limit]
    #[arg(long, value_name = "REQUESTS", value_parser = rate)]
    rate: Option<f64>,
}

pub(super) fn run(args: &KeysArgs) -> Result<(), CliError> {
    let config = args.settings.start()?;
    if matches!(args.action, KeysCommand::List) && !config.server.store().exists() {
        return print_line("there are no keys");
    }
    block_on(async {
        let store = open_store(&config).await?;
        match &args.action {
            KeysCommand::Create(args) => create(&store, args).await,
            KeysCommand::List => list(&store).await,
            KeysCommand::Revoke { key } => revoke(&store, key).await,
        }
    })
}

async fn create(store: &Store, args: &CreateArgs) -> Result<(), CliError> {
    let name = &args.name;
    if name.is_empty() || name.len() > 64 || name.chars().any(char::is_control) {
        return Err(CliError::Usage(format!(
            "{name:?} is not a name for a key; use one line of 1 to 64 bytes"
        )));
    }
    let order = KeyOrder {
        name,
        scope: args.scope,
        valid_s: args.expires,
        requests_per_s: args.rate,
    };
    print_line(create_key(store, order).await?)
}

/// Seconds of a time such as `30d` or `12h`, up to a hundred years.
fn duration_s(text: &str) -> Result<f64, String> {
    let units = [('s', 1.0), ('m', 60.0), ('h', 3600.0), ('d', SECONDS_PER_DAY)];
    let parsed = units.iter().find_map(|&(unit, seconds)| {
        let number: u32 = text.strip_suffix(unit)?.parse().ok()?;
        Some(f64::from(number) * seconds)
    });
    let in_range = parsed.filter(|seconds| (1.0..=36_500.0 * SECONDS_PER_DAY).contains(seconds));
    in_range.ok_or_else(|| "write a whole number with s, m, h or d, as in 30d: 1s to 36500d".to_owned())
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate| (0.001..=1e6).contains(rate));
    rate.ok_or_else(|| "write requests a second, 0.001 to 1000000".to_owned())
}

async fn list(store: &Store) -> Result<(), CliError> {
    let now_s = store.now_s().await?;
    for key in store.list_keys().await? {
        let state = match key.revoked_s {
            Some(_) => "revoked",
            None if !key.is_valid(now_s) => "expired",
            None => "valid",
        };
        let age_days = (now_s - key.created_s) / SECONDS_PER_DAY;
        let expires = key
            .expires_s
            .filter(|_| state == "valid")
            .map_or_else(String::new, |expires_s| {
                format!("expires in {:.1} days  ", (expires_s - now_s) / SECONDS_PER_DAY)
            });
        let rate = key
            .requests_per_s
            .map_or_else(String::new, |rate| format!("{rate} requests/s  "));
        let (id, scope, name) = (key.id, key.scope.name(), key.name);
        print_line(format!(
            "{id}  {state:7}  {age_days:6.1} days old  {scope:7}  {expires}{rate}{name}"
        ))?;
    }
    Ok(())
}

async fn revoke(store: &Store, wanted: &str) -> Result<(), CliError> {
    let now_s = store.now_s().await?;
    let mut valid = store.list_keys().await?;
    valid.retain(|key| key.is_valid(now_s));
    let named: Vec<&KeyRow> = match valid.iter().find(|key| key.id == wanted) {
        Some(key) => vec![key],
        None => valid.iter().filter(|key| key.name == wanted).collect(),
    };
    let found: Vec<&str> = named.iter().map(|key| &*key.id).collect();
    let id = match found[..] {
        [id] => id,
        [] => {
            return Err(CliError::Usage(format!(
                "there is no valid key {wanted}; foreframe keys list lists them"
            )));
        }
        [..] => {
            return Err(CliError::Usage(format!(
                "{} valid keys have the name {wanted}; give the id of one: {}",
                found.len(),
                found.join(", ")
            )));
        }
    };
    store.revoke_key(id, now_s, &Author::CommandLine).await?;
    let consequence = if valid.len() == 1 {
        "; it was the last valid key: every request is refused until another is created"
    } else {
        ""
    };
    print_line(format!("{id} is revoked{consequence}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_a_whole_number_with_a_unit() {
        assert_eq!(duration_s("30d"), Ok(30.0 * SECONDS_PER_DAY));
        assert_eq!(duration_s("12h"), Ok(12.0 * 3600.0));
        for wrong in ["", "d", "30", "0s", "-1d", "1.5h", "1w", "99999999d"] {
            assert!(duration_s(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_rate_is_positive() {
        assert_eq!(rate("0.5"), Ok(0.5));
        for wrong in ["0", "-1", "nan", "inf", "x"] {
            assert!(rate(wrong).is_err(), "{wrong}");
        }
    }
}
