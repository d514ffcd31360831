// Shows the OpenAPI document as a page.

import { el } from "./dom.js";

const openapi = await (await fetch("openapi.json")).json();

const named = (id) => el("a", { href: `#${id}` }, id);
const code = (text) => el("code", {}, text);
const typed = ({ schema }, kind) => (schema.$ref ? named(schema.$ref.split("/").pop()) : code(kind));

function list(schemas) {
  return el("dl", {}, Object.entries(schemas).map(([name, schema]) => [el("dt", {}, code(name)), el("dd", {}, schema.description ?? "")]));
}

function operation(path, method, description) {
  const body = Object.entries(description.requestBody?.content ?? {}).map(([kind, content]) => el("p", {}, "Takes ", code(kind), ": ", typed(content, "bytes"), "."));
  const responses = Object.entries(description.responses["200"].content).map(([kind, content]) => el("p", {}, "Returns ", typed(content, kind), "."));
  const parameters = Object.fromEntries(description.parameters.map(({ name, schema }) => [name, schema]));
  return [el("h2", {}, code(`${method.toUpperCase()} ${path}`)), el("p", {}, description.summary), list(parameters), body, responses];
}

document.title = `${openapi.info.title} ${openapi.info.version}`;
document.getElementById("main").append(...[
  Object.entries(openapi.paths).map(([path, methods]) => Object.entries(methods).map(([method, description]) => operation(path, method, description))),
  el("h2", {}, "Objects"),
  Object.entries(openapi.components.schemas).map(([name, schema]) =>
    [el("h3", { id: name }, name), el("pre", {}, schema.description), list(schema.properties ?? {})]),
].flat(9));
document.getElementById(location.hash.slice(1))?.scrollIntoView();
