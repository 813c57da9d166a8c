//! The bodies of an inference: a JSON header, and after it the bytes of the binary tensors.

use std::collections::BTreeMap;

use axum::body::Bytes;
use axum::extract::{FromRequest, Request};
use axum::http::{HeaderName, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::tensor::{InputHead, OutputHead, Tensor};
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_core::registry::Manifest;

/// The length of the JSON header, if bytes follow it.
const HEADER_LENGTH: HeaderName = HeaderName::from_static("inference-header-content-length");

#[derive(Deserialize)]
struct RequestHeader {
    id: Option<String>,
    #[serde(default)]
    parameters: RequestParameters,
    inputs: Vec<InputHead>,
    #[serde(default)]
    outputs: Vec<RequestedOutput>,
}

#[derive(Default, Deserialize)]
struct RequestParameters {
    steps: Option<usize>,
    sequence_id: Option<Value>,
    #[serde(default)]
    binary_data_output: bool,
}

#[derive(Deserialize)]
struct RequestedOutput {
    name: String,
    #[serde(default)]
    parameters: OutputParameters,
}

#[derive(Default, Deserialize)]
struct OutputParameters {
    binary_data: Option<bool>,
}

#[derive(Serialize)]
struct AnswerHead<'a> {
    model_name: &'a str,
    model_version: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameters: Option<AnswerParameters>,
    outputs: Vec<OutputHead<'a>>,
}

#[derive(Serialize)]
struct AnswerParameters {
    warnings: String,
}

/// A request for an inference. Refused before it is read if there is no place for its prediction.
pub(super) struct InferRequest {
    pub(super) inputs: BTreeMap<String, Tensor>,
    pub(super) steps: Option<usize>,
    pub(super) answer: AnswerForm,
}

/// How the client wants the answer.
pub(super) struct AnswerForm {
    id: Option<String>,
    /// All outputs if empty.
    outputs: Vec<RequestedOutput>,
    is_binary: bool,
}

impl FromRequest<App> for InferRequest {
    type Rejection = ApiError;

    async fn from_request(request: Request, app: &App) -> Result<Self, ApiError> {
        let request = app.admission.check(request).await?;
        let length = request
            .headers()
            .get(HEADER_LENGTH)
            .map(|length| length.to_str().ok()?.parse().ok());
        let bytes = Bytes::from_request(request, app).await?;
        let length: usize = match length {
            None => bytes.len(),
            Some(Some(length)) if length <= bytes.len() => length,
            Some(_) => {
                return Err(ApiError::Malformed(format!(
                    "the header Inference-Header-Content-Length must be a number up to the {} bytes of the body",
                    bytes.len()
                )));
            }
        };
        let (header, binary) = bytes.split_at(length);
        Self::read(header, binary)
    }
}

impl InferRequest {
    fn read(header: &[u8], mut binary: &[u8]) -> Result<Self, ApiError> {
        let header: RequestHeader = serde_json::from_slice(header).map_err(|error| {
            if error.is_data() {
                ApiError::Unprocessable(error.to_string())
            } else {
                ApiError::Malformed(format!("the header of the request is not JSON: {error}"))
            }
        })?;
        if header.parameters.sequence_id.is_some() {
            return Err(ApiError::Unprocessable(
                "sequences are not supported; send the whole context, or use POST /v1/sessions".to_owned(),
            ));
        }
        let mut inputs = BTreeMap::new();
        for head in header.inputs {
            let (tensor, rest) = Tensor::read(head, binary)?;
            binary = rest;
            if let Some(twice) = inputs.insert(tensor.name.clone(), tensor) {
                return Err(ApiError::Unprocessable(format!(
                    "input \"{}\" is there twice",
                    twice.name.escape_default()
                )));
            }
        }
        if !binary.is_empty() {
            return Err(ApiError::Malformed(format!(
                "{} bytes follow the last input",
                binary.len()
            )));
        }
        Ok(Self {
            inputs,
            steps: header.parameters.steps,
            answer: AnswerForm {
                id: header.id,
                outputs: header.outputs,
                is_binary: header.parameters.binary_data_output,
            },
        })
    }
}

impl AnswerForm {
    /// Errors: an output that the model does not have.
    pub(super) fn check(&self, known: &[&str], manifest: &Manifest) -> Result<(), ApiError> {
        let unknown = self
            .outputs
            .iter()
            .find(|output| !known.contains(&output.name.as_str()));
        unknown.map_or(Ok(()), |output| {
            Err(ApiError::Unprocessable(format!(
                "output \"{}\" is unknown; model \"{}\" gives {}",
                output.name.escape_default(),
                manifest.name,
                known.join(", ")
            )))
        })
    }

    /// The answer with the outputs that the client wants, in its order.
    pub(super) fn respond(self, manifest: &Manifest, outputs: Vec<Tensor>, warnings: &[String]) -> Response {
        let mut all: BTreeMap<String, Tensor> = outputs
            .into_iter()
            .map(|tensor| (tensor.name.clone(), tensor))
            .collect();
        let is_binary = |output: &RequestedOutput| output.parameters.binary_data.unwrap_or(self.is_binary);
        let chosen: Vec<(Tensor, bool)> = if self.outputs.is_empty() {
            all.into_values().map(|tensor| (tensor, self.is_binary)).collect()
        } else {
            let wanted = self.outputs.iter();
            wanted
                .filter_map(|output| Some((all.remove(&output.name)?, is_binary(output))))
                .collect()
        };
        let described = chosen.iter().map(|(tensor, is_binary)| tensor.described(*is_binary));
        let head = serde_json::to_vec(&AnswerHead {
            model_name: manifest.name.as_str(),
            model_version: manifest.version.to_string(),
            id: self.id,
            parameters: (!warnings.is_empty()).then(|| AnswerParameters {
                warnings: warnings.join("; "),
            }),
            outputs: described.collect(),
        });
        let mut body = head.expect("an answer that is not JSON is a bug");
        if !chosen.iter().any(|(_, is_binary)| *is_binary) {
            return ([(header::CONTENT_TYPE, "application/json")], body).into_response();
        }
        let length = body.len().to_string();
        for (tensor, _) in chosen.into_iter().filter(|(_, is_binary)| *is_binary) {
            body.extend(tensor.into_bytes());
        }
        let headers = [
            (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
            (HEADER_LENGTH, length),
        ];
        (headers, body).into_response()
    }
}
