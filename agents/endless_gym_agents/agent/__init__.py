"""The agent: transforms of observations, encoders, a memory, heads."""

from endless_gym_agents.agent.agent import ActOutput, Agent, AgentMemory, AgentOutput, make_agent

__all__ = ["ActOutput", "Agent", "AgentMemory", "AgentOutput", "make_agent"]
