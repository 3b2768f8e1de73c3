"""The door: FastAPI routes, authentication, problem details, websockets."""
