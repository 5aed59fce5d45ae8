//! OpenAPI document of `/api/v1`, generated from the route table and the types of the crate `api`.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use api::NDJSON;
use api::problem::{PROBLEM_JSON, Problem};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde_json::json;
use utoipa::openapi::content::Content;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::path::{HttpMethod, OperationBuilder, ParameterBuilder, ParameterIn, Paths};
use utoipa::openapi::request_body::RequestBodyBuilder;
use utoipa::openapi::schema::{Array, Components, KnownFormat, ObjectBuilder, Schema, SchemaFormat, Type};
use utoipa::openapi::security::{ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{InfoBuilder, OpenApi, OpenApiBuilder, Ref, RefOr, Required, ResponseBuilder, Server};
use utoipa::{IntoParams, PartialSchema, ToSchema};

use crate::errors::Error;
use crate::route_access::Access;
use crate::routes::{ROUTES, Route};

/// Prefix of all described paths.
const BASE: &str = "/api/v1";
const JSON: &str = "application/json";
const EVENT_STREAM: &str = "text/event-stream";
const HTML: &str = "text/html";
const DESCRIPTION: &str = "API of cloudroidd for cloudroidctl and the portal's page. Robots connect to \
    ws://host:port/SERVICE?robot=ID instead, which speaks rosbridge v2. Images are served read-only at /v2/ (OCI \
    distribution).";

type AnySchema = RefOr<Schema>;

/// Descriptions of the refusals, by status.
const REFUSALS: &[(u16, &str)] = &[
    (400, "The request is invalid."),
    (401, "No valid token, certificate or session."),
    (403, "Not permitted."),
    (404, "Not found; `exists` lists the existing names."),
    (408, "The body was not received in time."),
    (409, "Conflict with the current state."),
    (413, "The body is too large."),
    (422, "The request can never succeed as it is."),
    (426, "The WebSocket version is not supported."),
    (429, "Too many requests; see Retry-After."),
    (500, "The daemon failed."),
    (502, "Another component failed, such as the servant or the identity provider."),
    (503, "Temporarily unavailable; see Retry-After."),
    (507, "The disk is full."),
];
/// Refusals of any operation.
const ANY: &[u16] = &[400, 401, 403, 429, 500];
/// Refusals of operations whose path names an object.
const NAMED_OBJECT_REFUSALS: &[u16] = &[404];
/// Refusals of operations that read a body.
const WITH_BODY: &[u16] = &[408, 413, 503];
/// Further refusals of operations, by operation id.
const FURTHER_REFUSALS: &[(&str, &[u16])] = &[
    ("base", &[422]),
    ("bases", &[422]),
    ("calibrate", &[409]),
    ("cancelPush", &[409]),
    ("createAccount", &[409]),
    ("createToken", &[409]),
    ("exec", &[409, 426]),
    ("explainSla", &[422]),
    ("exportBase", &[409, 422]),
    ("fit", &[422]),
    ("importBase", &[404, 422]),
    ("inside", &[409, 426]),
    ("logs", &[409]),
    ("makeBase", &[409, 422]),
    ("oidcCallback", &[404, 502, 503]),
    ("oidcLogin", &[404, 502, 503]),
    ("orderRollout", &[409]),
    ("push", &[404, 409, 422]),
    ("removeBase", &[409, 422]),
    ("removeService", &[503]),
    ("removeUnderlay", &[409]),
    ("rollback", &[409]),
    ("setLimits", &[409, 422, 502]),
    ("stopServants", &[404]),
    ("takeRecording", &[409, 507]),
    ("topics", &[409]),
    ("trial", &[422, 502]),
];

/// Description of one method of one path.
pub struct Operation {
    id: String,
    built: OperationBuilder,
    reads_body: bool,
    /// Schemas that it refers to, by name.
    schemas: Vec<(String, AnySchema)>,
}

/// Creates an operation with its id, from which generated clients derive a name, and its summary.
pub fn operation(id: &str, summary: &str) -> Operation {
    Operation {
        id: id.to_owned(),
        built: OperationBuilder::new().operation_id(Some(id)).summary(Some(summary)),
        reads_body: false,
        schemas: Vec::new(),
    }
}

impl Operation {
    /// Declares a response with one JSON value.
    pub fn answers<T: ToSchema>(mut self) -> Self {
        let schema = self.register_schema::<T>();
        self.answer("200", "The requested file.", JSON, schema)
    }

    /// Declares a response with a JSON list.
    pub fn lists<T: ToSchema>(mut self) -> Self {
        let schema = Array::new(self.register_schema::<T>());
        self.answer("200", "The requested file.", JSON, Schema::Array(schema).into())
    }

    /// Declares a response with JSON lines.
    pub fn streams<T: ToSchema>(mut self) -> Self {
        let schema = self.register_schema::<T>();
        self.answer("200", "The requested file.", NDJSON, schema)
    }

    /// Declares a response with server-sent events whose data is JSON.
    pub fn sends<T: ToSchema>(mut self) -> Self {
        let schema = self.register_schema::<T>();
        self.answer("200", "The requested file.", EVENT_STREAM, schema)
    }

    /// Declares a response with a JSON object that is described elsewhere.
    pub fn answers_object(self) -> Self {
        let object = ObjectBuilder::new().schema_type(Type::Object);
        self.answer("200", "The requested file.", JSON, object.into())
    }

    /// Declares a response with a file of this media type.
    pub fn answers_file(self, media: &str) -> Self {
        let file =
            ObjectBuilder::new().schema_type(Type::String).format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        self.answer("200", "The requested file.", media, file.into())
    }

    /// Declares a redirect.
    pub fn redirects(mut self) -> Self {
        let response = ResponseBuilder::new().description("Redirect to Location.");
        self.built = self.built.response("303", response);
        self
    }

    /// Declares an empty response.
    pub fn answers_nothing(mut self) -> Self {
        let response = ResponseBuilder::new().description("Done.");
        self.built = self.built.response("204", response);
        self
    }

    /// Declares an upgrade to a WebSocket.
    pub fn becomes_a_websocket(mut self) -> Self {
        let response = ResponseBuilder::new().description("The connection is now a WebSocket.");
        self.built = self.built.response("101", response);
        self
    }

    /// Declares a response with an HTML page.
    pub fn answers_page(mut self) -> Self {
        let response = ResponseBuilder::new().description("The requested file.").content(HTML, page());
        self.built = self.built.response("200", response);
        self
    }

    /// Declares query parameters.
    pub fn asks<P: IntoParams>(mut self) -> Self {
        for parameter in P::into_params(|| Some(ParameterIn::Query)) {
            self.built = self.built.parameter(parameter);
        }
        self
    }

    /// Declares a query parameter that holds JSON.
    pub fn asks_json<T: ToSchema>(mut self, name: &str, description: &str) -> Self {
        // `ParameterBuilder` does not support `content`.
        let content = Content::new(Some(self.register_schema::<T>()));
        self.built = self.built.parameter(
            ParameterBuilder::new()
                .name(name)
                .parameter_in(ParameterIn::Query)
                .description(Some(description))
                .extensions(Some(Extensions::from_iter([("content", json!({ JSON: content }))]))),
        );
        self
    }

    /// Declares a JSON body.
    pub fn takes<T: ToSchema>(mut self, required: Required) -> Self {
        let schema = self.register_schema::<T>();
        self.body(JSON, schema, RequestBodyBuilder::new(), required)
    }

    /// Declares a body that is a file of this media type.
    pub fn takes_file(self, media: &str, description: &str, required: Required) -> Self {
        let file =
            ObjectBuilder::new().schema_type(Type::String).format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        let body = RequestBodyBuilder::new().description(Some(description));
        self.body(media, file.into(), body, required)
    }

    fn body(mut self, media: &str, schema: AnySchema, body: RequestBodyBuilder, required: Required) -> Self {
        let body = body.content(media, Content::new(Some(schema))).required(Some(required));
        self.built = self.built.request_body(Some(body.build()));
        self.reads_body = true;
        self
    }

    fn answer(mut self, status: &str, what: &str, media: &str, schema: AnySchema) -> Self {
        let response = ResponseBuilder::new().description(what).content(media, Content::new(Some(schema)));
        self.built = self.built.response(status, response);
        self
    }

    /// Adds the schema of a type to the document and returns a reference to it.
    fn register_schema<T: ToSchema>(&mut self) -> AnySchema {
        T::schemas(&mut self.schemas);
        self.schemas.push((T::name().into_owned(), T::schema()));
        Ref::from_schema_name(T::name()).into()
    }
}

/// Returns the statuses with which an operation at this path may be refused.
fn refusals(path: &str, operation: &Operation) -> BTreeSet<u16> {
    let named = if path.contains('{') { NAMED_OBJECT_REFUSALS } else { &[] };
    let body = if operation.reads_body { WITH_BODY } else { &[] };
    let more = FURTHER_REFUSALS.iter().filter(|(id, _)| *id == operation.id);
    let more = more.flat_map(|(_, statuses)| *statuses);
    let all = ANY.iter().chain(named).chain(body).chain(more);
    all.copied().collect()
}

/// Returns the name of the response shared by all refusals of a status.
fn name_of_refusal(status: u16) -> String {
    format!("Refused{status}")
}

/// Describes a refusal: a problem document or, where a browser was redirected, an HTML page if it asks for one.
fn refusal(words: &str, is_page: bool) -> utoipa::openapi::Response {
    let problem = Content::new(Some(Ref::from_schema_name(Problem::name())));
    let response = ResponseBuilder::new().description(words).content(PROBLEM_JSON, problem);
    if is_page { response.content(HTML, page()).build() } else { response.build() }
}

/// Describes an HTML page.
fn page() -> Content {
    let text = ObjectBuilder::new().schema_type(Type::String);
    Content::new(Some(Schema::from(text.build())))
}

/// Builds the document from the routes that have an operation.
fn document(routes: &[Route]) -> OpenApi {
    let mut paths = Paths::new();
    let mut components = Components::new();
    let (problem, mut schemas) = (Problem::schema(), Vec::new());
    Problem::schemas(&mut schemas);
    components.schemas.extend(schemas);
    components.schemas.insert(Problem::name().into_owned(), problem);
    for (status, words) in REFUSALS {
        let all = refusal(words, false);
        components.responses.insert(name_of_refusal(*status), all.into());
    }
    for route in routes {
        let (Some(operation), Some(path), Some(method)) =
            (route.operation, route.path.strip_prefix(BASE), method(route.method))
        else {
            continue;
        };
        let operation = operation();
        let statuses = refusals(path, &operation);
        let Operation { mut built, schemas, .. } = operation;
        for (status, words) in REFUSALS {
            if !statuses.contains(status) {
                continue;
            }
            // Only browsers are sent there.
            built = if path.starts_with("/oidc/") {
                built.response(status.to_string(), refusal(words, true))
            } else {
                let all = Ref::from_response_name(name_of_refusal(*status));
                built.response(status.to_string(), all)
            };
        }
        for parameter in path_parameters(path) {
            built = built.parameter(parameter);
        }
        if route.access == Access::Code {
            // Its body authenticates the caller.
            built = built.security(SecurityRequirement::default());
        }
        paths.add_path_operation(path, vec![method], built);
        components.schemas.extend(schemas);
    }
    let token = Http::new(HttpAuthScheme::Bearer);
    components.add_security_scheme("bearer", SecurityScheme::Http(token));
    let token = ApiKey::Query(ApiKeyValue::new("token"));
    components.add_security_scheme("query", SecurityScheme::ApiKey(token));
    let none: [&str; 0] = [];
    OpenApiBuilder::new()
        .info(InfoBuilder::new().title("Cloudroid").version("1").description(Some(DESCRIPTION)))
        .servers(Some([Server::new(BASE)]))
        .security(Some([
            SecurityRequirement::new("bearer", none),
            SecurityRequirement::new("query", none),
            SecurityRequirement::default(),
        ]))
        .paths(paths)
        .components(Some(components))
        .build()
}

fn method(name: &str) -> Option<HttpMethod> {
    Some(match name {
        "GET" => HttpMethod::Get,
        "POST" => HttpMethod::Post,
        "PATCH" => HttpMethod::Patch,
        "PUT" => HttpMethod::Put,
        "DELETE" => HttpMethod::Delete,
        _ => return None,
    })
}

/// Returns the path parameters: in `/services/{name}`, the service.
fn path_parameters(path: &str) -> impl Iterator<Item = ParameterBuilder> {
    let collections = path.split('/');
    collections.zip(path.split('/').skip(1)).filter_map(|(collection, segment)| {
        let name = segment.strip_prefix('{')?.strip_suffix('}')?;
        let text = ObjectBuilder::new().schema_type(Type::String);
        Some(
            ParameterBuilder::new()
                .name(name)
                .parameter_in(ParameterIn::Path)
                .required(Required::True)
                .description(Some(format!("The {}.", collection.trim_end_matches('s'))))
                .schema(Some(text)),
        )
    })
}

/// Responds with the OpenAPI document.
pub async fn serve() -> Result<Response, Error> {
    static DOCUMENT: LazyLock<Option<Bytes>> = LazyLock::new(|| {
        let text = document(ROUTES).to_json().ok()?;
        Some(Bytes::from(text))
    });
    let document = DOCUMENT.as_ref().ok_or(Error::Internal("describing the portal"))?;
    Ok(([(header::CONTENT_TYPE, JSON)], document.clone()).into_response())
}

#[cfg(test)]
mod tests;
