//! The OpenAPI document of `/api/v1`, made of the table of routes and of the types of crate `api`.

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
use utoipa::openapi::schema::{
    Array, Components, KnownFormat, ObjectBuilder, Schema, SchemaFormat, Type,
};
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::{
    InfoBuilder, OpenApi, OpenApiBuilder, Ref, RefOr, Required, ResponseBuilder, Server,
};
use utoipa::{IntoParams, PartialSchema, ToSchema};

use crate::errors::Error;
use crate::routes::{Access, ROUTES, Route};

/// What all addresses that are described begin with.
const BASE: &str = "/api/v1";
const JSON: &str = "application/json";
const EVENT_STREAM: &str = "text/event-stream";
const HTML: &str = "text/html";
const ABOUT: &str = "What cloudroidctl and the portal's page ask of cloudroidd. Robots connect elsewhere: \
                     ws://host:port/SERVICE?robot=ID speaks rosbridge v2. Images are served read-only at /v2/ (OCI \
                     distribution).";

type AnySchema = RefOr<Schema>;

/// What a refusal of each status says, in a few words.
const REFUSED: &[(u16, &str)] = &[
    (400, "Something in the request is not what it should be."),
    (401, "Nobody is known who asks."),
    (403, "Who asks may not."),
    (
        404,
        "There is no such thing; exists names those that there are.",
    ),
    (408, "The body was not complete in time."),
    (409, "It stands against what is there now."),
    (413, "The body is too big."),
    (422, "It cannot be, whenever it is asked."),
    (426, "The WebSocket handshake is of another version."),
    (429, "Too many; Retry-After says when to ask again."),
    (500, "The daemon failed."),
    (502, "Whoever was asked in turn did not answer."),
    (503, "Not now; Retry-After says when to ask again."),
    (507, "There is no room on the disk."),
];
/// With what any operation may be refused.
const ANY: &[u16] = &[400, 401, 403, 429, 500];
/// One of something that the address names.
const NAMED: &[u16] = &[404];
/// One whose body is read first.
const WITH_BODY: &[u16] = &[408, 413, 503];
/// Operations that may be refused with more, by their ids.
const MORE: &[(&str, &[u16])] = &[
    ("calibrate", &[409]),
    ("createAccount", &[409]),
    ("createToken", &[409]),
    ("explainSla", &[422]),
    ("fit", &[422]),
    ("inside", &[409, 426]),
    ("logs", &[409]),
    ("oidcCallback", &[404, 502, 503]),
    ("oidcLogin", &[404, 502, 503]),
    ("orderRollout", &[409]),
    ("push", &[409, 422]),
    ("removeService", &[503]),
    ("rollback", &[409]),
    ("setLimits", &[409, 422, 502]),
    ("stopServants", &[404]),
    ("takeRecording", &[409, 507]),
    ("topics", &[409]),
    ("trial", &[422, 502]),
];

/// One method at one address, in words and schemas.
pub struct Operation {
    id: String,
    built: OperationBuilder,
    reads_body: bool,
    /// Schemas that it refers to, by name.
    schemas: Vec<(String, AnySchema)>,
}

/// An operation: its id, by which generators of clients call it, and what it does.
pub fn operation(id: &str, summary: &str) -> Operation {
    Operation {
        id: id.to_owned(),
        built: OperationBuilder::new()
            .operation_id(Some(id))
            .summary(Some(summary)),
        reads_body: false,
        schemas: Vec::new(),
    }
}

impl Operation {
    /// It answers one value as JSON.
    pub fn answers<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", JSON, schema)
    }

    /// It answers a list as JSON.
    pub fn lists<T: ToSchema>(mut self) -> Self {
        let schema = Array::new(self.named::<T>());
        self.answer("200", "As asked.", JSON, Schema::Array(schema).into())
    }

    /// It answers values as JSON lines.
    pub fn streams<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", NDJSON, schema)
    }

    /// It answers server-sent events, whose data is a value as JSON.
    pub fn sends<T: ToSchema>(mut self) -> Self {
        let schema = self.named::<T>();
        self.answer("200", "As asked.", EVENT_STREAM, schema)
    }

    /// It answers a JSON object that is described elsewhere.
    pub fn answers_object(self) -> Self {
        let object = ObjectBuilder::new().schema_type(Type::Object);
        self.answer("200", "As asked.", JSON, object.into())
    }

    /// It answers a file of this media type.
    pub fn answers_file(self, media: &str) -> Self {
        let file = ObjectBuilder::new()
            .schema_type(Type::String)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        self.answer("200", "As asked.", media, file.into())
    }

    /// It sends a browser elsewhere.
    pub fn leads_on(mut self) -> Self {
        let response = ResponseBuilder::new().description("Elsewhere, by Location.");
        self.built = self.built.response("303", response);
        self
    }

    /// It answers that it was done.
    pub fn answers_nothing(mut self) -> Self {
        let response = ResponseBuilder::new().description("Done.");
        self.built = self.built.response("204", response);
        self
    }

    /// It becomes a WebSocket.
    pub fn becomes_a_websocket(mut self) -> Self {
        let response = ResponseBuilder::new().description("A WebSocket from here on.");
        self.built = self.built.response("101", response);
        self
    }

    /// It answers a page for people.
    pub fn answers_page(mut self) -> Self {
        let response = ResponseBuilder::new()
            .description("As asked.")
            .content(HTML, page());
        self.built = self.built.response("200", response);
        self
    }

    /// It reads these from the query.
    pub fn asks<P: IntoParams>(mut self) -> Self {
        for parameter in P::into_params(|| Some(ParameterIn::Query)) {
            self.built = self.built.parameter(parameter);
        }
        self
    }

    /// It reads a value as JSON from the query.
    pub fn asks_json<T: ToSchema>(mut self, name: &str, description: &str) -> Self {
        // `ParameterBuilder` knows no `content`.
        let content = Content::new(Some(self.named::<T>()));
        self.built = self.built.parameter(
            ParameterBuilder::new()
                .name(name)
                .parameter_in(ParameterIn::Query)
                .description(Some(description))
                .extensions(Some(Extensions::from_iter([(
                    "content",
                    json!({ JSON: content }),
                )]))),
        );
        self
    }

    /// Its body is a value as JSON.
    pub fn takes<T: ToSchema>(mut self, required: Required) -> Self {
        let schema = self.named::<T>();
        self.body(JSON, schema, RequestBodyBuilder::new(), required)
    }

    /// Its body is a file of this media type.
    pub fn takes_file(self, media: &str, description: &str, required: Required) -> Self {
        let file = ObjectBuilder::new()
            .schema_type(Type::String)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary)));
        let body = RequestBodyBuilder::new().description(Some(description));
        self.body(media, file.into(), body, required)
    }

    fn body(
        mut self,
        media: &str,
        schema: AnySchema,
        body: RequestBodyBuilder,
        required: Required,
    ) -> Self {
        let body = body
            .content(media, Content::new(Some(schema)))
            .required(Some(required));
        self.built = self.built.request_body(Some(body.build()));
        self.reads_body = true;
        self
    }

    fn answer(mut self, status: &str, what: &str, media: &str, schema: AnySchema) -> Self {
        let response = ResponseBuilder::new()
            .description(what)
            .content(media, Content::new(Some(schema)));
        self.built = self.built.response(status, response);
        self
    }

    /// Refers to a type's schema, which the document then holds.
    fn named<T: ToSchema>(&mut self) -> AnySchema {
        T::schemas(&mut self.schemas);
        self.schemas.push((T::name().into_owned(), T::schema()));
        Ref::from_schema_name(T::name()).into()
    }
}

/// With what an operation at this path may be refused.
fn refusals(path: &str, operation: &Operation) -> BTreeSet<u16> {
    let named = if path.contains('{') { NAMED } else { &[] };
    let body = if operation.reads_body { WITH_BODY } else { &[] };
    let more = MORE.iter().filter(|(id, _)| *id == operation.id);
    let more = more.flat_map(|(_, statuses)| *statuses);
    let all = ANY.iter().chain(named).chain(body).chain(more);
    all.copied().collect()
}

/// The name of the response that all refusals of a status are.
fn name_of_refusal(status: u16) -> String {
    format!("Refused{status}")
}

/// A refusal: a problem; where a browser was sent, a page for its person if it asks for one.
fn refusal(words: &str, is_page: bool) -> utoipa::openapi::Response {
    let problem = Content::new(Some(Ref::from_schema_name(Problem::name())));
    let response = ResponseBuilder::new()
        .description(words)
        .content(PROBLEM_JSON, problem);
    match is_page {
        true => response.content(HTML, page()).build(),
        false => response.build(),
    }
}

/// A page for people.
fn page() -> Content {
    let text = ObjectBuilder::new().schema_type(Type::String);
    Content::new(Some(Schema::from(text.build())))
}

/// Describes those routes that have an operation.
fn document(routes: &[Route]) -> OpenApi {
    let mut paths = Paths::new();
    let mut components = Components::new();
    let (problem, mut schemas) = (Problem::schema(), Vec::new());
    Problem::schemas(&mut schemas);
    components.schemas.extend(schemas);
    components
        .schemas
        .insert(Problem::name().into_owned(), problem);
    for (status, words) in REFUSED {
        let all = refusal(words, false);
        components
            .responses
            .insert(name_of_refusal(*status), all.into());
    }
    for route in routes {
        let (Some(operation), Some(path), Some(method)) = (
            route.operation,
            route.path.strip_prefix(BASE),
            method(route.method),
        ) else {
            continue;
        };
        let operation = operation();
        let statuses = refusals(path, &operation);
        let Operation {
            mut built, schemas, ..
        } = operation;
        for (status, words) in REFUSED {
            if !statuses.contains(status) {
                continue;
            }
            // Browsers alone are sent there.
            built = match path.starts_with("/oidc/") {
                true => built.response(status.to_string(), refusal(words, true)),
                false => {
                    let all = Ref::from_response_name(name_of_refusal(*status));
                    built.response(status.to_string(), all)
                }
            };
        }
        for parameter in named_in(path) {
            built = built.parameter(parameter);
        }
        if route.access == Access::Code {
            // Its body says who asks.
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
        .info(
            InfoBuilder::new()
                .title("Cloudroid")
                .version("1")
                .description(Some(ABOUT)),
        )
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

/// What is named in a path: in `/services/{name}`, the service.
fn named_in(path: &str) -> impl Iterator<Item = ParameterBuilder> {
    let collections = path.split('/');
    collections
        .zip(path.split('/').skip(1))
        .filter_map(|(collection, segment)| {
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

/// The description of all this.
pub async fn serve() -> Result<Response, Error> {
    static DOCUMENT: LazyLock<Option<Bytes>> = LazyLock::new(|| {
        let text = document(ROUTES).to_json().ok()?;
        Some(Bytes::from(text))
    });
    let document = DOCUMENT
        .as_ref()
        .ok_or(Error::Internal("describing the portal"))?;
    Ok(([(header::CONTENT_TYPE, JSON)], document.clone()).into_response())
}

#[cfg(test)]
mod tests;
